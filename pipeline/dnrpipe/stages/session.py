"""One command's hold on a workspace: found or made, locked, with its settings resolved."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from ..core.cameras import KEYWORDS, read_camera_file
from ..core.console import Console
from ..core.errors import UserError
from ..core.ledger import StageName
from ..core.scene_files import split_views
from ..core.settings import Settings, merge, parse_assignment, resolve
from ..core.workspace import (
    DamagedManifest,
    Manifest,
    Source,
    Workspace,
    file_sha256,
    find_workspace,
    locked,
    sha256_now,
)
from .inspect_scene import require_file
from .pipeline import STAGES, require_inputs, run_stage, state
from .select import check_budget
from .stage import Run

UNTRAINED: tuple[StageName, ...] = ("select", "raytrace", "finetune")
"""Stages between `prepare` and frames; without views they take seconds."""


OWN_ENDING = {"shot": ".shot.dnr"}
"""Of commands whose workspaces, where nobody names one, are not those of the others: their cameras differ."""
FIRST_PRESET = {"shot": "standard"}
"""What commands begin a workspace with, where nobody names a preset and it is not draft."""


class Session:
    """One locked workspace with its settings, for the length of a command."""

    def __init__(
        self,
        command: str,
        options: dict[str, Any],
        scene: Path | None,
        overrides: dict[str, Any],
        late: Callable[[Settings], dict[str, Any]] | None = None,
    ) -> None:
        self.command, self.options, self.scene, self.overrides = command, options, scene, overrides
        self.late = late  # overrides that depend on the settings in force
        self.stack = ExitStack()
        self.answers: dict[str, Any] = {}
        self.before: Manifest | None = None
        self.fresh = False
        self.passing: dict[str, Any] = {}
        """Of the overrides those that hold for this command alone."""

    def __enter__(self) -> Session:
        try:
            return self._open()
        except BaseException:
            self.stack.close()
            raise

    def _open(self) -> Session:
        self.console = Console(json_mode=self.options["as_json"], quiet=self.options["quiet"])
        overrides = self.overrides
        for text in self.options["assignments"]:
            overrides = merge(overrides, parse_assignment(text))
        if self.scene is not None:
            require_file(self.scene)
            source = Source(path=str(self.scene.resolve()), sha256=file_sha256(self.scene))
            named = self.options["workspace"] or os.environ.get("DNRPIPE_WORKSPACE")
            root = Path(named or f"{self.scene.stem}{OWN_ENDING.get(self.command, '.dnr')}")
            # Bad settings are refused before a folder is made.
            stored = _stored(root, source, named=self.options["workspace"] is not None)
            preset = self._preset(stored)
            planned = resolve_layers(root, preset or (stored.manifest.preset if stored else None), stored, overrides)
            self._check(planned, stored)
            self.fresh = stored is None and not root.exists()
            self.stack.enter_context(locked(root, self.command))
            self.before = stored.manifest if stored else None
            self.workspace = Workspace.create(root, source)
        else:
            root = find_workspace(self.options["workspace"])
            Workspace.open(root)
            self.stack.enter_context(locked(root, self.command))
            self.workspace = Workspace.open(root)
            preset = self._preset(self.workspace)
            self.before = self.workspace.manifest.model_copy(deep=True)
        self.settings = resolve_settings(self.workspace, overrides, preset)
        if self.late is not None:
            overrides = merge(overrides, self.late(self.settings))
            self.settings = resolve_settings(self.workspace, overrides, preset)
        manifest = self.workspace.manifest
        self._check(self.settings, self.workspace)
        manifest.preset = preset or manifest.preset
        if sha256 := self.settings.cameras.source_sha256:  # workspaces live on without their camera file
            overrides = merge(overrides, {"cameras": {"source_sha256": sha256}})
        manifest.overrides = merge(manifest.overrides, {k: v for k, v in overrides.items() if k != "executor"})
        self.passing = {k: v for k, v in overrides.items() if k == "executor"}
        if self.settings.executor.engine != "local":
            self.workspace.root = self.workspace.root.resolve()  # paths in tasks say where files lie
        return self

    def _preset(self, stored: Workspace | None) -> str | None:
        """The preset that the flag names, else the one that this command begins a workspace with; None: as it is.

        stored: the workspace as it is on disk. One that was never prepared is as new: its first run was refused or
        interrupted.
        """
        given = self.options["preset"]
        begun = stored is not None and (stored.manifest.preset or stored.manifest.prepared)
        return given or (FIRST_PRESET.get(self.command) if not begun else None)

    def __exit__(self, *exception: Any) -> None:
        self.stack.__exit__(*exception)

    @property
    def run(self) -> Run:
        """The command's work on the workspace, under the settings in force."""
        return Run(self.workspace, self.settings, self.console)

    def stages(self, *names: StageName) -> None:
        """Run stages in order; flags are remembered once the first one's inputs are known to be there."""
        require_inputs(STAGES[names[0]], self.workspace, self.settings)
        self.workspace.manifest.settings = self.settings.model_dump(mode="json")
        self.workspace.save()
        if "prepare" in names:
            size = f"{self.settings.cameras.width}x{self.settings.cameras.height}"
            self.console.say(f"workspace {self.workspace.root}, preset {self.settings.preset} ({size})")
        for name in names:
            if name == "evaluate" and self.command == "run" and not split_views(self.workspace).get("test"):
                self.console.warn("no test views: nothing is evaluated; prepare with cameras.test > 0")
                continue
            try:
                self.answers[name] = run_stage(name, self.run, force=self.options["force"])
            except UserError:
                if name == "prepare":
                    self._take_back()
                raise
        if self.command not in ("run", "plan", "frontier", "shot"):  # these have an answer of their own
            self.console.result({"workspace": str(self.workspace.root), **self.answers})

    def renderer(self) -> None:
        """See to it that frames can be rendered: by the fine-tuned renderer, else as `untrained` says.

        Raises UserError: views were selected, and a stage on the way to a renderer has not run.
        """
        self.untrained()
        require_inputs(STAGES["evaluate"], self.workspace, self.settings)  # what it needs is what frames need

    def untrained(self) -> None:
        """Where no view was ever selected, the shipped corrector becomes the renderer, as with ``--budget 0``."""
        if not selects_nothing(self.workspace, self.settings):
            return
        self.settings = self.settings.with_budget(0)
        for name in UNTRAINED:
            if state(STAGES[name], self.workspace, self.settings) != "done":
                run_stage(name, self.run)

    def adopt(self, overrides: dict[str, Any]) -> None:
        """Settings found by the command itself, remembered as flags are."""
        manifest = self.workspace.manifest
        manifest.overrides = merge(manifest.overrides, overrides)
        self.settings = resolve_settings(self.workspace, self.passing, manifest.preset)
        self.workspace.save()

    def _take_back(self) -> None:
        """A refused scene or camera file leaves the workspace as it was; a folder made for it is removed."""
        if self.fresh:
            shutil.rmtree(self.workspace.root, ignore_errors=True)
        elif self.before is not None:
            self.workspace.manifest = self.before
            self.workspace.save()

    def _check(self, settings: Settings, workspace: Workspace | None) -> None:
        """Refuse bad camera files and a budget above the candidates before any work is done or folder made."""
        prepared = workspace.manifest.prepared if workspace else None
        reads = self.command == "prepare" or (self.scene is not None and self.command != "shot")
        if settings.cameras.source not in KEYWORDS and reads:  # a shot brings cameras of its own
            read_camera_file(Path(settings.cameras.source), settings.cameras)
        if self.command == "run" and settings.cameras.source in ("auto", "dome", "sphere"):
            check_budget(settings.select.budget, settings.cameras.train)
        elif self.command == "select" and prepared is not None:
            check_budget(settings.select.budget, prepared.views["train"])


def selects_nothing(workspace: Workspace, settings: Settings) -> bool:
    """Whether the shipped corrector is what renders: no view was ever selected, and it corrects such base images."""
    record = workspace.manifest.stages.get("select")
    return settings.model.base == "baked" and (record is None or not record.detail["views"])


def _stored(root: Path, source: Source, *, named: bool) -> Workspace | None:
    """The workspace that is there, or None. A damaged manifest is put aside: the work is found by its files.

    Raises UserError: it belongs to another scene of the same name and was not named with -w.
    """
    path = root / "manifest.json"
    if not path.exists():
        return None
    try:
        workspace = Workspace.open(root)
    except DamagedManifest:
        path.replace(root / "manifest.json.damaged")
        return None
    other = Path(workspace.manifest.source.path)
    if not named and str(other) != source.path and other.exists():
        raise UserError(f"{root}: belongs to {other}; name another workspace with -w")
    return workspace


def resolve_settings(workspace: Workspace, overrides: dict[str, Any], preset: str | None) -> Settings:
    return resolve_layers(workspace.root, preset or workspace.manifest.preset, workspace, overrides)


def settings_of_last_run(workspace: Workspace) -> Settings:
    """The settings that the workspace was last worked with, wherever this command runs and whatever files lie there:
    for who reads what stages have made. Those of now where they are of another version."""
    try:
        return Settings.model_validate(workspace.manifest.settings or None)
    except ValidationError:
        return resolve_settings(workspace, {}, None)


def resolve_layers(root: Path, preset: str | None, stored: Workspace | None, overrides: dict[str, Any]) -> Settings:
    """preset < ./dnrpipe.toml < workspace's dnrpipe.toml < environment < flags given before < flags."""
    files = [path for path in (Path("dnrpipe.toml"), root / "dnrpipe.toml") if path.is_file()]
    flags = merge(stored.manifest.overrides if stored else {}, overrides)
    cameras = overrides.get("cameras")
    if isinstance(cameras, dict) and "source" in cameras and "source_sha256" not in cameras:
        flags = merge(flags, {"cameras": {"source_sha256": ""}})  # the remembered one is another file's
    return _with_camera_file(resolve(preset, flags, toml_files=files))


def _with_camera_file(settings: Settings) -> Settings:
    """With the hash of the camera file as it is now, whichever layer names it; the remembered one where it is gone.

    Raises UserError: it cannot be read.
    """
    cameras, path = settings.cameras, Path(settings.cameras.source)
    try:
        found = "" if cameras.source in KEYWORDS else sha256_now(path) if path.is_file() else cameras.source_sha256
    except OSError as error:
        raise UserError(f"cameras.source = {path}: cannot be read ({error.strerror})") from None
    return settings.model_copy(update={"cameras": cameras.model_copy(update={"source_sha256": found})})
