"""The workspace: one folder per scene, its manifest, its lock, and how commands find it.

scene.dnr/
  manifest.json                 schema version, source hash, flags given so far, state of each stage
  scene/                        source.blend, Mitsuba bundle, geometry.npz, census, frame
  cameras/{train,val,test}.json
  passes/<split>/<view>.exr     G-buffers and rasterised colour
  selection.json                the chosen views, in order
  raytraced/<split>/<view>.exr  path-traced views
  base/                         baked light; base images, base/<split>/<view>.exr
  checkpoints/{step1,step2}/    weights and histories
  preview/                      a held-out view as fine-tuning last rendered it
  evaluation/  renders/  shots/  report/  logs/
  costs.jsonl                   the ledger
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from pydantic import BaseModel, Field, ValidationError, field_validator

from dnrtrain.atomic import write_json
from dnrtrain.records import first_error

from .errors import UserError
from .ledger import Ledger

SCHEMA = 1
SUFFIX = ".dnr"
LOCK_FILES = (".lock", ".lock-owner")


class StageRecord(BaseModel, extra="forbid"):
    """What a finished stage leaves in the manifest.

    Args:
        fingerprint: hash of what the stage computed from.
        output: hash of what it made, as far as later stages can see it.
        finished: unix seconds.
        seconds: wall time of the run that finished it.
        detail: what ``--json`` tells of it. `Manifest` reads back what other stages need.
    """

    fingerprint: str
    output: str
    finished: float
    seconds: float
    detail: dict[str, Any] = Field(default_factory=dict)


class PrepareDetail(BaseModel, strict=True):
    """What stage `prepare` tells of itself.

    raster_engine: "" where no rasterised colour was wanted. views: how many, by split. drawn: splits that have passes
    -> whether with rasterised colour.
    """

    raster_engine: str = ""
    raster_reason: str = ""
    views: dict[str, int]
    drawn: dict[str, bool] = Field(default_factory=lambda: {"train": True, "val": True, "test": False})
    triangles: int = 0


class RaytraceDetail(BaseModel, strict=True):
    """What stage `raytrace` tells of itself. views: their names. spp: samples per pixel; a list where views differ."""

    views: list[str]
    spp: int | list[int | None] | None = None


class Source(BaseModel, extra="forbid"):
    """The scene file a workspace was made from. ``path`` is absolute; the workspace lives without it."""

    path: str
    sha256: str


class Manifest(BaseModel, extra="forbid", populate_by_name=True):
    """``manifest.json``. overrides: the flags given so far. settings: the last resolved copy."""

    schema_version: int = Field(default=SCHEMA, alias="schema")
    source: Source
    preset: str | None = None
    overrides: dict[str, Any] = Field(default_factory=dict)
    settings: dict[str, Any] = Field(default_factory=dict)
    stages: dict[str, StageRecord] = Field(default_factory=dict)
    versions: dict[str, str] = Field(default_factory=dict)

    @field_validator("stages")
    @classmethod
    def _readable(cls, stages: dict[str, StageRecord]) -> dict[str, StageRecord]:
        """What other commands read of a record is there."""
        for name, kind in (("prepare", PrepareDetail), ("raytrace", RaytraceDetail)):
            try:
                found = kind.model_validate(stages[name].detail) if name in stages else None
            except ValidationError as error:
                raise ValueError(f"stage {name}: {error.errors()[0]['msg']}") from None
            if isinstance(found, PrepareDetail) and "train" not in found.views:
                raise ValueError("stage prepare does not say how many views it has")
        return stages

    @property
    def prepared(self) -> PrepareDetail | None:
        """What stage `prepare` did; None before it has."""
        return PrepareDetail.model_validate(self.stages["prepare"].detail) if "prepare" in self.stages else None

    @property
    def raytraced(self) -> RaytraceDetail | None:
        """What stage `raytrace` did; None before it has."""
        return RaytraceDetail.model_validate(self.stages["raytrace"].detail) if "raytrace" in self.stages else None


class DamagedManifest(UserError):
    """``manifest.json`` is truncated or foreign; preparing the scene again makes a new one."""


class Workspace:
    """Paths and the manifest of one workspace. Open with `open`, make with `create`."""

    def __init__(self, root: Path, manifest: Manifest) -> None:
        self.root = root
        self.manifest = manifest
        self.ledger = Ledger(root / "costs.jsonl")
        # Every stage names its files through these paths, and the methods below.
        self.scene, self.selection = root / "scene", root / "selection.json"
        self.evaluation, self.preview = root / "evaluation", root / "preview"

    def cameras(self, split: str) -> Path:
        return self.root / "cameras" / f"{split}.json"

    def passes(self, split: str, view: str) -> Path:
        return self.root / "passes" / split / f"{view}.exr"

    def raytraced(self, split: str, view: str) -> Path:
        return self.root / "raytraced" / split / f"{view}.exr"

    def checkpoints(self, step: str) -> Path:
        return self.root / "checkpoints" / step

    def log(self, stage: str) -> Path:
        return self.root / "logs" / f"{stage}.log"

    # Manifest

    @classmethod
    def create(cls, root: Path, source: Source) -> Workspace:
        """Make the folder and its manifest, or take over the one that is there (with its stages)."""
        if (root / "manifest.json").exists():
            workspace = cls.open(root)
            workspace.manifest.source = source
        elif root.exists() and not _is_ours(root):
            raise UserError(f"{root}: exists and is not a dnrpipe workspace; choose another with -w")
        else:
            workspace = cls(root, Manifest(source=source))  # pyright: ignore[reportCallIssue]
        workspace.save()
        return workspace

    @classmethod
    def open(cls, root: Path) -> Workspace:
        """Read a workspace. Raises UserError: not one, damaged, or made by a newer dnrpipe."""
        path = root / "manifest.json"
        try:
            data = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise UserError(f"{root}: not a dnrpipe workspace; make one with `dnrpipe prepare SCENE`") from None
        except (ValueError, RecursionError) as error:
            raise DamagedManifest(f"{path}: damaged ({error}); run `dnrpipe prepare SCENE` again") from None
        schema = data.get("schema") if isinstance(data, dict) else None
        if isinstance(schema, int) and schema > SCHEMA:
            raise UserError(f"{root}: workspace schema {schema} is newer than this dnrpipe ({SCHEMA}); upgrade dnrpipe")
        try:
            return cls(root, Manifest.model_validate(data))
        except ValidationError as error:
            reason = first_error(error)
            raise DamagedManifest(f"{path}: damaged ({reason}); run `dnrpipe prepare SCENE` again") from None

    def save(self) -> None:
        write_json(self.root / "manifest.json", self.manifest.model_dump(mode="json", by_alias=True))

    def finish_stage(self, name: str, **facts: Any) -> None:
        """Record that a stage is done, the last thing a stage does. facts: fields of `StageRecord` but ``finished``."""
        self.manifest.stages[name] = StageRecord(finished=time.time(), **facts)
        self.save()


def _is_ours(root: Path) -> bool:
    """Nothing in the folder but a lock, or what an earlier dnrpipe left whose manifest was put aside."""
    names = {entry.name for entry in root.iterdir()} - set(LOCK_FILES)
    return not names or "manifest.json.damaged" in names


def find_workspace(explicit: str | None) -> Path:
    """-w, else DNRPIPE_WORKSPACE, else the folder we stand in, else the only ``*.dnr`` here."""
    folder = Path.cwd()
    named = explicit or os.environ.get("DNRPIPE_WORKSPACE")
    if named:
        return Path(named)
    for candidate in (folder, *folder.parents):
        if (candidate / "manifest.json").exists() and candidate.suffix == SUFFIX:
            return candidate
    found = sorted(p for p in folder.glob(f"*{SUFFIX}") if (p / "manifest.json").exists())
    if len(found) == 1:
        return found[0]
    if not found:
        raise UserError(f"no workspace in {folder}; make one with `dnrpipe prepare SCENE` or name it with -w")
    raise UserError(f"several workspaces here ({', '.join(p.name for p in found)}); name one with -w")


@contextmanager
def locked(root: Path, purpose: str) -> Iterator[None]:
    """Hold the workspace for one process. Raises UserError naming the holder when it is taken.

    The lock is the kernel's (flock): it goes with the process, however that ends.
    """
    root.mkdir(parents=True, exist_ok=True)
    lock, owner = FileLock(root / LOCK_FILES[0], timeout=0), root / LOCK_FILES[1]
    try:
        lock.acquire()
    except Timeout:
        try:
            holder = owner.read_text(encoding="utf-8").strip()
        except OSError:
            holder = "another process"
        raise UserError(f"{root}: {holder} is working on it; wait for it or stop it") from None
    try:
        owner.write_text(f"dnrpipe {purpose} (process {os.getpid()})\n", encoding="utf-8")
        yield
    finally:
        owner.unlink(missing_ok=True)
        lock.release()


def digest(value: Any) -> str:
    """Short stable hash of a JSON-able value."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:24]


def file_sha256(path: Path) -> str:
    """SHA-256 of a file's bytes, read in pieces."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def sha256_now(path: Path) -> str:
    """`file_sha256` of the file as it is; one command asks many times, so it is read again only when it changed."""
    stat = path.stat()
    return _sha256_cached(path, stat.st_mtime_ns, stat.st_size)


@functools.lru_cache(maxsize=16384)
def _sha256_cached(path: Path, modified_ns: int, size: int) -> str:
    del modified_ns, size  # part of the key only
    return file_sha256(path)
