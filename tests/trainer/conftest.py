"""The analytic scene on disk, and one thread per test process (machines that test are shared)."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))  # importlib mode keeps helpers off the path

import synthetic

from dnrtrain.dataset import ViewSet, load_views
from dnrtrain.perceptual import PerceptualLoss, random_weights
from dnrtrain.settings import Step2Settings

TRAIN, TEST, SIDE = 10, 4, 32


class Scene(NamedTuple):
    folder: Path
    raster: ViewSet
    traced: ViewSet
    held_out: ViewSet
    """ray-traced targets of views that are not in training"""


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def perceptual() -> PerceptualLoss:
    """On random weights."""
    return PerceptualLoss(random_weights("vgg"), Step2Settings().perceptual_weights)


def make_scene(folder: Path, train: int, test: int, side: int) -> Scene:
    views = synthetic.dome(train, side)
    others = synthetic.dome(test, side, seed=1, prefix="t")
    passes, images = synthetic.write_scene(folder, views)
    other_passes, other_images = synthetic.write_scene(folder, others)
    frame = synthetic.FRAME
    return Scene(
        folder,
        load_views(passes, None, frame, cameras=views, folder=folder),
        load_views(passes, images, frame, cameras=views, folder=folder),
        load_views(other_passes, other_images, frame, cameras=others, folder=folder),
    )


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """10 training and 4 held-out views, 32×32."""
    return make_scene(tmp_path_factory.mktemp("scene"), TRAIN, TEST, SIDE)
