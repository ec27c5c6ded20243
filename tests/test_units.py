"""A bundle written in larger units shows the same picture."""

from __future__ import annotations

import os
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("bpy")

from dnrpipe.blender.bundle.units import rescale, unit_scale
from dnrpipe.raytrace import sensors as units
from dnrpipe.raytrace.variants import choose_variant
from dnrtrain.contract import View

# Everything with a length in it: lamps of each kind, a medium, an instance, a rotated and stretched shape.
BUNDLE = """<scene version="3.0.0">
  <integrator type="volpath"><integer name="max_depth" value="6"/></integrator>
  <sensor type="perspective" id="sensor">
    <float name="fov" value="45"/><float name="near_clip" value="0.5"/><float name="far_clip" value="50"/>
    <transform name="to_world"><matrix value="-1 0 0 0 0 0.6 0.8 -4 0 0.8 -0.6 3 0 0 0 1"/></transform>
    <film type="hdrfilm"><integer name="width" value="32"/><integer name="height" value="32"/></film>
    <sampler type="independent"><integer name="sample_count" value="64"/></sampler>
  </sensor>
  <bsdf type="diffuse" id="grey"><rgb name="reflectance" value="0.6 0.5 0.4"/></bsdf>
  <bsdf type="null" id="nothing"/>
  <medium type="homogeneous" id="smoke">
    <rgb name="sigma_t" value="1 0.8 0.6"/><float name="scale" value="2"/><rgb name="albedo" value="0.7 0.8 0.9"/>
  </medium>
  <shape type="rectangle"><transform name="to_world"><matrix value="2 0 0 0 0 2 0 0 0 0 1 0 0 0 0 1"/></transform>
    <ref id="grey"/></shape>
  <shape type="cube">
    <transform name="to_world"><matrix value="0.3 0 0 -0.8 0 0.2 0 0.4 0 0 0.5 0.5 0 0 0 1"/></transform>
    <ref id="nothing"/><ref id="smoke" name="interior"/></shape>
  <shape type="shapegroup" id="group"><shape type="cube"><ref id="grey"/></shape></shape>
  <shape type="instance"><ref id="group"/>
    <transform name="to_world"><matrix value="0.2 0.1 0 0.7 -0.1 0.2 0 0.2 0 0 0.2 0.3 0 0 0 1"/></transform></shape>
  <shape type="sphere" id="light-a"><point name="center" x="1" y="-1" z="2"/><float name="radius" value="0.2"/>
    <emitter type="dnr_lamp"><rgb name="radiance" value="8 7 6"/><string name="profile" value="point"/>
      <float name="soft" value="0.2"/></emitter></shape>
  <emitter type="point"><point name="position" x="-1" y="-1" z="1.5"/><rgb name="intensity" value="2 3 4"/></emitter>
  <emitter type="spot"><rgb name="intensity" value="9 8 7"/><float name="cutoff_angle" value="30"/>
    <transform name="to_world"><matrix value="1 0 0 0.2 0 -1 0 0.3 0 0 -1 2.5 0 0 0 1"/></transform></emitter>
  <emitter type="constant"><rgb name="radiance" value="0.1 0.1 0.1"/></emitter>
</scene>"""

RENDER = """
import sys, numpy as np, mitsuba as mi
from dnrpipe.raytrace import plugins
mi.set_variant(sys.argv[1])
plugins.register(mi)
np.save(sys.argv[3], np.array(mi.render(mi.load_file(sys.argv[2], parallel=False), seed=3, spp=int(sys.argv[4]))))
"""


def rendered(path: Path, spp: int) -> np.ndarray:
    out = path.with_suffix(".npy")
    choice = choose_variant()
    command = [sys.executable, "-c", RENDER, choice.variant, str(path), str(out), str(spp)]
    done = subprocess.run(
        command, env=os.environ | choice.environment, capture_output=True, text=True, timeout=200, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return np.load(out)


def test_usual_sizes_are_left_alone() -> None:
    assert unit_scale(1.7) == unit_scale(0.2) == unit_scale(3e4) == 1.0
    for radius in (1e-4, 0.03, 4e6):
        factor = unit_scale(radius)
        assert 0.7 < radius * factor < 1.5
        assert np.log2(factor) == round(np.log2(factor))


@pytest.mark.parametrize("factor", [256.0, 2.0**-10])
def test_same_picture_in_other_units(tmp_path: Path, factor: float) -> None:
    (tmp_path / "plain.xml").write_text(BUNDLE)
    root = ET.fromstring(BUNDLE)
    rescale(root, factor)
    (tmp_path / "scaled.xml").write_text(ET.tostring(root, encoding="unicode"))
    assert units.unit_scale(tmp_path / "scaled.xml") == factor
    assert units.unit_scale(tmp_path / "plain.xml") == 1.0
    plain, scaled = rendered(tmp_path / "plain.xml", 64), rendered(tmp_path / "scaled.xml", 64)
    assert plain[..., :3].mean() > 0.05
    assert scaled[..., :3].mean() == pytest.approx(plain[..., :3].mean(), rel=3e-3)
    # The same random numbers: only rays that graze something differ, through the step off a surface.
    assert np.median(np.abs(scaled - plain)) < 2e-3 * plain[..., :3].mean()


def test_cameras_move_with_the_scene() -> None:
    matrix = ((1.0, 0.0, 0.0, 2.0), (0.0, 1.0, 0.0, 3.0), (0.0, 0.0, 1.0, 4.0), (0.0, 0.0, 0.0, 1.0))
    view = View(name="v", width=8, height=8, fl_x=8, fl_y=8, cx=4, cy=4, c2w=matrix)
    scaled = units.scaled_view(view, 4.0)
    assert np.allclose(scaled.matrix[:3, 3], [8, 12, 16])
    assert np.allclose(scaled.matrix[:3, :3], view.matrix[:3, :3])
    assert units.scaled_lens({"aperture_radius": 0.1, "focus_distance": 2.0}, 4.0) == {
        "aperture_radius": 0.4,
        "focus_distance": 8.0,
    }
    assert units.scaled_lens(None, 4.0) is None
