"""What all cells of a scene share: its workspace, ray-traced views, references and base images."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from dnrtrain.contract import View

from ...core.console import Console
from ...core.errors import UserError
from ...core.ledger import StageName
from ...core.scene_files import read_raster_choice, split_views
from ...core.settings import Settings
from ...core.workspace import Source, Workspace, file_sha256
from ...effects.store import plan_of
from ...stages.base_images import RENDERED, base_path, base_views
from ...stages.pipeline import run_stage
from ...stages.prepare import draw_missing, draw_passes
from ...stages.raytrace import trace_views
from ...stages.stage import Run

COLLECTION = Path(__file__).resolve().parents[4] / "blender_scenes"
"""The scenes of the repository; installed from a wheel there are none, and scenes are named by their files."""
BENCHMARK = (
    "bricks", "drums", "foliage", "food", "furniture", "materials", "microphone", "ship", "interior", "jewels"
)  # fmt: skip
HARD_LIGHT = ("interior", "jewels")


@dataclass
class Scene:
    """One prepared scene of a study.

    name: results are filed by it. train, test: views by name. inputs: hash of passes and cameras. run_id: of the study
    in the ledger.
    """

    name: str
    workspace: Workspace
    console: Console
    train: dict[str, View]
    test: dict[str, View]
    inputs: str
    run_id: str

    def run(self, settings: Settings, stage: StageName) -> Run:
        """Work on the scene, booked under the stage."""
        return Run(self.workspace, settings, self.console, stage, self.run_id)


BY_POSE = ("farthest", "random")
"""Rules of camera poses alone."""


def choose_by_pose(views: Sequence[View], policy: str, budget: int, seed: int) -> list[View]:
    """The views that a rule of `BY_POSE` chooses."""
    from dnrtrain.selector.policies import untrained
    from dnrtrain.selector.protocol import Candidates

    rule = untrained(policy)
    assert rule is not None
    return [views[place] for place in rule.choose(Candidates.of_views(views), budget, seed).views]


def without_left_out(workspace: Workspace, settings: Settings) -> Settings:
    """The settings without what the scene's effect plan leaves off of the model."""
    return settings.model_copy(update={"model": plan_of(workspace, settings).model(settings.model)})


def scene_workspace(source: Path, root: Path) -> Workspace:
    """Make or find the workspace of a scene file in a study's folder."""
    return Workspace.create(root, Source(path=str(source), sha256=file_sha256(source)))


def find_scenes(text: str | None) -> list[Path]:
    """Scene files: paths, or names of the repository's scenes; None is the ten benchmark scenes.

    Raises UserError: no such scene, or two of one name.
    """
    found: list[Path] = []
    for name in [part.strip() for part in text.split(",") if part.strip()] if text else BENCHMARK:
        candidates = (Path(name), COLLECTION / f"{name}.blend", COLLECTION / "hard" / f"{name}.blend")
        path = next((p for p in candidates if p.is_file()), None)
        if path is None:
            raise UserError(f"--scenes {name}: neither a scene file nor a scene of {COLLECTION}")
        found.append(path.resolve())
    if not found:
        raise UserError("--scenes: names no scene")
    stems = [path.stem for path in found]
    if twice := {stem for stem in stems if stems.count(stem) > 1}:
        raise UserError(f"--scenes: two scenes are named {', '.join(sorted(twice))}; results are filed by name")
    return found


def prepared(name: str, run: Run, command: str) -> Scene:
    """The workspace's passes, made where they are missing, without a word. command: names the study in the ledger.

    Raises UserError: no test views, too few candidates.
    """
    workspace, settings = run.workspace, run.settings
    silent = replace(run, console=Console(json_mode=run.console.json_mode, quiet=True))
    run_stage("prepare", silent)
    draw_missing(silent.for_stage("prepare"), {"train": True, "val": True, "test": False})
    views = split_views(workspace)
    if not views.get("test"):
        raise UserError(f"{name}: has no test views to measure on; set cameras.test > 0")
    train = {view.name: view for view in views["train"]}
    if settings.select.most > len(train):
        raise UserError(f"a budget of {settings.select.most} views: {name} has {len(train)} candidate views")
    return Scene(
        name=name,
        workspace=workspace,
        console=run.console,
        train=train,
        test={view.name: view for view in views["test"]},
        inputs=workspace.manifest.stages["prepare"].output,
        run_id=f"{command}-{int(time.time()):x}",
    )


def trace_train(scene: Scene, settings: Settings, names: Iterable[str], spp: int | None = None) -> dict[str, str]:
    """Path-trace the named candidates that are not there yet -> fingerprint of each view's file.

    spp: instead of the settings'; the pictures then lie in a split of their own (`traced_split`).
    """
    chosen = set(names)
    wanted = [view for name, view in scene.train.items() if name in chosen]
    return _trace(scene.run(settings, "raytrace"), wanted, traced_split(settings, spp), spp)


def traced_split(settings: Settings, spp: int | None) -> str:
    """Folder under ``raytraced/`` of training views at ``spp`` samples; the settings' samples lie in ``train``."""
    return "train" if spp in (None, settings.raytrace.spp) else f"train-{spp}spp"


def trace_references(scene: Scene, settings: Settings) -> list[str]:
    """Path-trace the test views, booked as evaluation -> fingerprints of their files, sorted."""
    return sorted(_trace(scene.run(settings, "evaluate"), list(scene.test.values()), "test").values())


def make_bases(scene: Scene, settings: Settings, train: Sequence[str]) -> dict[str, str]:
    """Make the base images that ``settings`` call for, of the named candidates and all test views.

    -> fingerprint of each view's base image by ``train/NAME`` or ``test/NAME``.
    """
    workspace = scene.workspace
    if settings.model.base == "raster":
        choice = read_raster_choice(workspace)
        assert choice is not None, "stage prepare has chosen one"
        tasks = draw_passes(
            scene.run(settings, "prepare"),
            "rasterised test views",
            list(scene.test.values()),
            [raster_file(workspace, name) for name in scene.test],
            choice.engine,
            raster=[True] * len(scene.test),
        )
        drawn = {f"train/{name}": scene.inputs for name in train}  # by `prepare`
        return drawn | {f"test/{name}": task["fingerprint"] for name, task in zip(scene.test, tasks, strict=True)}
    chosen = {"train": [scene.train[name] for name in train], "test": list(scene.test.values())}
    made = {}
    for split, views in chosen.items():
        tasks = base_views(
            scene.run(settings, "evaluate" if split == "test" else "finetune"),
            views,
            split,
            paths=base_files(workspace, settings.model.base, split, [view.name for view in views]),
        )
        made |= {f"{split}/{view.name}": task["fingerprint"] for view, task in zip(views, tasks, strict=True)}
    return made


def base_files(workspace: Workspace, kind: str, split: str, views: Iterable[str]) -> list[Path]:
    """Where the views' base images lie: the workspace's own place for baked ones, beside it for the kinds it is not.

    Empty for kinds that are not rendered into files of their own.
    """
    folder = split if kind == "baked" else f"{kind}-{split}"
    return [base_path(workspace, folder, view) for view in views] if kind in RENDERED else []


def raster_file(workspace: Workspace, view: str) -> Path:
    """Where a test view's passes with rasterised colour lie (`prepare` leaves that colour out)."""
    return workspace.root / "base" / "raster-test" / f"{view}.exr"


def _trace(run: Run, views: list[View], split: str, spp: int | None = None) -> dict[str, str]:
    tasks = trace_views(run, views, split, spp=spp)
    return {view.name: task["fingerprint"] for view, task in zip(views, tasks, strict=True)}


def raster_engine(root: Path) -> str:
    """What drew the rasterised colour of a workspace's folder: a timing chose it, and it decides pictures."""
    prepared = Workspace.open(root).manifest.prepared
    return prepared.raster_engine if prepared else ""
