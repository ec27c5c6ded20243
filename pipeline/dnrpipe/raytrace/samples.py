"""What passes over a view have added up to so far: kept between passes, runs and targets.

One uncompressed .npz per view: ``groups``, float32 [G, H, W, 4], the mean of each group of samples (linear Rec.709,
premultiplied), and ``facts``, JSON. 128 bytes a pixel with G = 8. Files may be deleted at any time; the views are then
traced from the start.
"""

from __future__ import annotations

import json
import zipfile
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dnrtrain.atomic import atomic_path

from .noise import GROUPS


@dataclass
class Facts:
    """fingerprint: hash of all that decides the samples (scene, view, integrator, seed), not how many there are.

    spp: in all groups together. launches: kernels launched so far, from which the next one's seed is counted.
    noise, error: see `noise.Noise`; of all samples. seconds, cpu_seconds: spent on them; booked_*: the part
    that the ledger knows. repaired, masked: non-finite pixels traced again, and set to zero.
    """

    fingerprint: str
    spp: int = 0
    launches: int = 0
    passes: int = 0
    noise: float | None = None
    error: float | None = None
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    booked_seconds: float = 0.0
    booked_cpu_seconds: float = 0.0
    repaired: int = 0
    masked: int = 0


@dataclass
class Samples:
    """groups: float64 [G, H, W, 4]."""

    groups: np.ndarray
    facts: Facts = field(default_factory=lambda: Facts(""))

    @property
    def mean(self) -> np.ndarray:
        """[H, W, 4]."""
        return self.groups.mean(axis=0)

    @property
    def halves(self) -> tuple[np.ndarray, np.ndarray]:
        """Two independent pictures of half the samples each."""
        return self.groups[0::2].mean(axis=0), self.groups[1::2].mean(axis=0)

    def add(self, more: np.ndarray, spp: int) -> None:
        """more: means of the groups of another ``spp`` samples."""
        total = self.facts.spp + spp
        self.groups = (self.groups * self.facts.spp + more * spp) / total
        self.facts.spp, self.facts.passes = total, self.facts.passes + 1

    def save(self, path: Path) -> None:
        """Atomically. What is in memory afterwards is what a reader of the file sees."""
        stored = self.groups.astype(np.float32)
        with atomic_path(path) as temporary:
            np.savez(temporary, groups=stored, facts=np.array(json.dumps(asdict(self.facts))))
        self.groups = stored.astype(np.float64)


def read_facts(path: Path, fingerprint: str) -> Facts:
    """The facts without the pixels; new ones where there is no file, a damaged one, or one of something else."""
    return _read(path, fingerprint, pixels=False)[0]


def read_samples(path: Path, fingerprint: str, height: int, width: int) -> Samples:
    """What is on disk, or no samples yet: see `read_facts`."""
    facts, groups = _read(path, fingerprint, pixels=True)
    if groups is None or groups.shape != (GROUPS, height, width, 4) or not np.isfinite(groups).all():
        return Samples(np.zeros((GROUPS, height, width, 4)), Facts(fingerprint))
    return Samples(groups.astype(np.float64), facts)


def _read(path: Path, fingerprint: str, *, pixels: bool) -> tuple[Facts, np.ndarray | None]:
    try:
        with np.load(path, allow_pickle=False) as data:
            known: dict[str, Any] = json.loads(str(data["facts"]))
            if known.get("fingerprint") == fingerprint:
                return Facts(**known), data["groups"] if pixels else None
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        pass  # missing, torn or foreign: begin again
    return Facts(fingerprint), None
