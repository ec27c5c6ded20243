"""Reading views: values, conventions, augmentation, refusals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import synthetic
import torch

from conftest import Scene
from dnrtrain.contract import ContractError
from dnrtrain.dataset import DIHEDRAL_ORDER, load_views
from dnrtrain.exr import read_exr, write_exr


def test_values_follow_the_contract(scene: Scene) -> None:
    views = scene.traced
    inside = views.tensors.mask > 0.5
    assert views.size == (32, 32) and len(views) == 10 and views.names[0] == "0000"
    assert torch.allclose(views.tensors.normal.norm(dim=1, keepdim=True)[inside], torch.ones(1), atol=1e-5)
    assert torch.allclose(views.tensors.view_dir.norm(dim=1), torch.ones(1), atol=1e-5)
    assert views.tensors.depth.min() >= 0 and views.tensors.depth.max() <= 1 and views.tensors.uv.abs().max() <= 1
    assert (views.tensors.uv[~inside.expand_as(views.tensors.uv)] == 0).all()
    assert views.tensors.target is not None and views.tensors.target.min() >= 0 and views.tensors.target.max() <= 1


def test_view_direction_points_from_surface_to_camera(scene: Scene) -> None:
    channels, _ = read_exr(scene.folder / "passes" / "0003.exr")
    position = np.stack([channels[f"position.{axis}"] for axis in "XYZ"])
    index = scene.traced.index("0003")
    towards = scene.traced.camera_positions[index][:, None, None] - position
    towards /= np.linalg.norm(towards, axis=0)
    error = np.abs(towards - scene.traced.tensors.view_dir[index].numpy()).max(axis=0)
    assert error[channels["mask"] > 0].max() < 1e-5


def test_background_is_white_and_raster_differs(scene: Scene) -> None:
    assert scene.traced.tensors.target is not None and scene.raster.tensors.target is not None
    empty = (scene.traced.tensors.coverage == 0).expand(-1, 3, -1, -1)
    assert (scene.traced.tensors.target[empty] == 1).all()
    assert (scene.traced.tensors.target - scene.raster.tensors.target).abs().mean() > 0.01


def test_augmentation_moves_inputs_and_target_alike(scene: Scene) -> None:
    """After any symmetry the same pixel still carries the same UV, normal and colour; all 8 differ."""
    batch = scene.traced.batch([2])
    seen = set()
    for element in range(DIHEDRAL_ORDER):
        turned = batch.augment(element)
        assert turned.target is not None and batch.target is not None

        def rows(part: object) -> torch.Tensor:
            stack = torch.cat([part.uv, part.normal, part.view_dir, part.target], dim=1)  # type: ignore[attr-defined]
            return stack[0].flatten(1).t()

        before, after = rows(batch), rows(turned)
        order_before = np.lexsort(before.numpy().T)
        order_after = np.lexsort(after.numpy().T)
        assert torch.equal(before[order_before], after[order_after])
        seen.add(turned.target.numpy().tobytes())
    assert len(seen) == DIHEDRAL_ORDER


def test_quarter_turn_of_a_wide_image(scene: Scene) -> None:
    batch = scene.traced.batch([0, 1])._map(lambda tensor: tensor[..., :20])
    assert batch.augment(1).mask.shape[-2:] == (20, 32)


def test_names_and_subsets(scene: Scene) -> None:
    part = scene.traced.subset([4, 1])
    assert part.names == ("0004", "0001")
    assert torch.equal(part.tensors.uv[1], scene.traced.tensors.uv[1])
    assert np.array_equal(part.c2w[0], scene.traced.c2w[4])
    with pytest.raises(ContractError, match="nobody"):
        scene.traced.index("nobody")


def test_without_target(scene: Scene) -> None:
    view = synthetic.dome(10, 32)[0]
    path = scene.folder / "passes" / "0000.exr"
    channels, _ = read_exr(path)
    bare = scene.folder / "bare.exr"
    write_exr(bare, {k: v for k, v in channels.items() if k not in "RGBA"}, {})
    views = load_views([bare], None, synthetic.FRAME, cameras=[view], folder=scene.folder, target=False)
    assert views.tensors.target is None
    with pytest.raises(ContractError, match="channels A, B, G, R are missing"):
        load_views([bare], None, synthetic.FRAME, cameras=[view], folder=scene.folder)


def test_mixed_resolutions_and_damage_are_refused(scene: Scene, tmp_path: Path) -> None:
    small = synthetic.dome(2, 16)[0]
    large = synthetic.dome(10, 32)[0]
    (small_file,), _ = synthetic.write_scene(tmp_path, [small])
    large_file = scene.folder / "passes" / "0000.exr"

    def load(files: list[Path], cameras: list) -> None:
        load_views(files, None, synthetic.FRAME, cameras=cameras, folder=tmp_path)

    with pytest.raises(ContractError, match="one resolution"):
        load([large_file, small_file], [large, small])
    with pytest.raises(ContractError, match="its camera 32x32"):
        load([small_file], [large])
    with pytest.raises(ContractError, match="must agree"):
        load([large_file], [large, large])
    with pytest.raises(ContractError, match="no views"):
        load([], [])
    small_file.write_bytes(small_file.read_bytes()[:200])
    with pytest.raises(ContractError, match="damaged"):
        load([small_file], [small])
