"""The ``dnr_*`` plugins of Mitsuba by themselves: known energies in a white furnace, both variants alike."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dnrpipe.raytrace import plugins

mi = pytest.importorskip("mitsuba")


@pytest.fixture(autouse=True)
def _variant(mitsuba_variant: str) -> None:
    plugins.register(mi)  # twice is harmless


def rgb(*value: float) -> dict[str, Any]:
    return {"type": "rgb", "value": list(value)}


def diffuse(value: float) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": rgb(value, value, value)}


def furnace(bsdf: dict[str, Any], integrator: str = "path") -> np.ndarray:
    """Mean radiance [3] of a sphere's middle under radiance 1 from everywhere: its albedo seen straight on."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": integrator, "max_depth": 8},
            "sensor": {
                "type": "perspective",
                "fov": 1,
                "to_world": mi.ScalarTransform4f().look_at([0, -10, 0], [0, 0, 0], [0, 0, 1]),
                "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}},
            },
            "light": {"type": "constant"},
            "ball": {"type": "sphere", "bsdf": bsdf},
        }
    )
    return np.array(mi.render(scene, spp=1024, seed=1)).mean(axis=(0, 1))


def test_sum_adds_smooth_and_mirror_lobes() -> None:
    mirror = {"type": "conductor", "material": "none", "specular_reflectance": rgb(0.5, 0.5, 0.5)}
    assert furnace({"type": "dnr_add", "a": diffuse(0.3), "b": diffuse(0.4)}) == pytest.approx(0.7, abs=0.005)
    assert furnace({"type": "dnr_add", "a": diffuse(0.3), "b": mirror}) == pytest.approx(0.8, abs=0.01)


@pytest.mark.parametrize("integrator", ["path", "volpath"])
def test_transparency_tints_at_both_walls(integrator: str) -> None:
    found = furnace({"type": "dnr_transparent", "transmittance": rgb(0.5, 0.8, 1.0)}, integrator)
    assert found == pytest.approx([0.25, 0.64, 1.0], abs=1e-3)


def test_transparency_without_tint_is_a_mask() -> None:
    nested = {"type": "twosided", "nested": diffuse(0.5)}
    ours = furnace({"type": "dnr_transparent", "opacity": 0.3, "nested": nested})
    assert ours == pytest.approx(furnace({"type": "mask", "opacity": 0.3, "nested": nested}), abs=0.01)


@pytest.mark.parametrize("kind", [{"type": "dielectric"}, {"type": "roughdielectric", "alpha": 0.05}])
def test_refraction_loses_nothing(kind: dict[str, Any]) -> None:
    nested = {**kind, "int_ior": 1.45, "ext_ior": 1.0}
    assert furnace({"type": "dnr_refraction", "eta": 1.45, "nested": nested}) == pytest.approx(1.0, abs=0.01)
    assert furnace(nested) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("eta", [1.45, 0.7])
def test_rough_interface_keeps_the_energy_that_one_scattering_loses(eta: float) -> None:
    """Through two walls, or thrown back from below, of a sphere in light from everywhere."""
    rough = {"type": "roughdielectric", "distribution": "ggx", "alpha": 0.36, "int_ior": eta, "ext_ior": 1.0}
    kept = furnace({"type": "dnr_interface", "eta": eta, "roughness": 0.6, "nested": rough})
    lost = furnace(rough)
    assert (lost < 0.95).all()
    assert kept == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("layer", [{}, {"metallic": 1.0}, {"coat": 1.0, "coat_roughness": 0.1}])
def test_principled_keeps_white_white(layer: dict[str, Any]) -> None:
    found = furnace({"type": "dnr_principled", "base_color": rgb(1, 1, 1), "roughness": 0.6, **layer})
    assert found == pytest.approx(1.0, abs=0.015)


def test_principled_coat_of_black_reflects_its_fresnel_term() -> None:
    black = {"type": "dnr_principled", "base_color": rgb(0, 0, 0), "roughness": 1.0, "eta": 1.0001}
    coated = furnace({**black, "coat": 1.0, "coat_roughness": 0.05, "coat_eta": 1.5})
    assert furnace(black) == pytest.approx(0.0, abs=1e-3)
    assert coated == pytest.approx(0.04, abs=0.002)


def test_view_table_is_read_by_the_cosine() -> None:
    table = np.zeros((2, 256, 3), np.float32)
    table[0] = np.linspace(0, 0.6, 256)[:, None]
    table[1] = 9.0  # the back, which nobody sees
    texture = {
        "type": "dnr_view",
        "size": 256,
        "values": {"type": "bitmap", "bitmap": mi.Bitmap(table), "raw": True, "wrap_mode": "clamp"},
    }
    assert furnace({"type": "diffuse", "reflectance": texture}) == pytest.approx(0.6, abs=0.02)


@pytest.mark.parametrize("flip", [0, 180])
def test_open_emitter_glows_on_both_sides(flip: float) -> None:
    transform = mi.ScalarTransform4f
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "direct"},
            "sensor": {
                "type": "perspective",
                "fov": 20,
                "to_world": transform().look_at([0, 0, 0.9], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}},
            },
            "lamp": {
                "type": "rectangle",
                "to_world": transform().translate([0, 0, 1]).rotate([1, 0, 0], flip).scale(0.5),
                "emitter": {"type": "dnr_area", "radiance": 3.0},
            },
            "floor": {"type": "rectangle", "to_world": transform().scale(4), "bsdf": diffuse(0.5)},
        }
    )
    # Radiosity's form factor of two parallel unit squares at distance 1 is 0.1998, from the middle 0.2395.
    assert np.array(mi.render(scene, spp=256)).mean() == pytest.approx(3.0 * 0.5 * 0.2395, rel=0.03)


def bent(normal: list[float], nested: dict[str, Any], **more: Any) -> dict[str, Any]:
    texel = np.array(normal, np.float32) / np.linalg.norm(normal) * 0.5 + 0.5
    picture = {"type": "bitmap", "bitmap": mi.Bitmap(texel.reshape(1, 1, 3)), "raw": True}
    return {"type": "dnr_normal", "normal": picture, "nested": {"type": "twosided", "nested": nested}, **more}


def sheet(bsdf: dict[str, Any], light: dict[str, Any], *, turn: float = 0.0) -> float:
    """Mean radiance of a sheet in the plane z = 0, turned about z, seen at 60 degrees from +x."""
    camera = mi.ScalarTransform4f().look_at([8.66, 0, 5], [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path"},
            "sensor": {"type": "perspective", "fov": 1, "to_world": camera, "film": film},
            "light": light,
            "sheet": {"type": "rectangle", "to_world": mi.ScalarTransform4f().rotate([0, 0, 1], turn), "bsdf": bsdf},
        }
    )
    return float(np.array(mi.render(scene, spp=64, seed=1)).mean())


def test_tangent_space_turns_with_the_surface() -> None:
    sun = {"type": "directional", "direction": [0.3, 0, -1], "irradiance": 1.0}
    found = sheet(bent([0, -0.5, 1], diffuse(0.5), space="tangent"), sun, turn=90)
    normal, towards = np.array([0.5, 0, 1]) / np.sqrt(1.25), np.array([-0.3, 0, 1]) / np.sqrt(1.09)
    assert found == pytest.approx(0.5 / np.pi * normal @ towards, rel=0.01)
    assert found == pytest.approx(sheet(bent([0.5, 0, 1], diffuse(0.5)), sun), rel=0.01)
    assert found < 0.9 * sheet(bent([0, -0.5, 1], diffuse(0.5)), sun, turn=90)


def test_bent_mirrors_mirror_what_is_above_the_surface() -> None:
    """A normal that tilts away from the viewer so far that it would mirror the ground."""
    mirror = {"type": "conductor", "material": "none"}
    sky = {"type": "constant"}
    assert sheet(bent([-1, 0, 1], mirror), sky) == pytest.approx(1.0, abs=0.01)
    assert sheet(bent([0.2, 0, 1], mirror), sky) == pytest.approx(1.0, abs=0.01)


def test_unknown_profile_and_missing_parts_are_refused() -> None:
    with pytest.raises(RuntimeError, match="no profile"):
        mi.load_dict({"type": "sphere", "emitter": {"type": "dnr_lamp", "profile": "laser", "radiance": 1.0}})
    with pytest.raises(RuntimeError, match="no space"):
        mi.load_dict(bent([0, 0, 1], diffuse(0.5), space="object"))
    with pytest.raises(RuntimeError, match="exactly two"):
        mi.load_dict({"type": "dnr_add", "a": diffuse(0.5)})


def test_translucency_keeps_the_energy_of_its_colour() -> None:
    """A ball of it in light from everywhere: what leaves the wall came through a wall, over and over, share c each."""
    assert furnace({"type": "dnr_translucent", "color": rgb(1.0, 1.0, 1.0)}) == pytest.approx(1.0, abs=0.03)
    sheet = mi.load_dict({"type": "dnr_translucent", "color": rgb(0.6, 0.7, 0.3)})
    si = mi.SurfaceInteraction3f()
    si.wi = mi.Vector3f(0, 0, 1)
    same, across = (sheet.eval(mi.BSDFContext(), si, mi.Vector3f(0, 0, z)) for z in (1, -1))
    assert np.array(same).ravel() == pytest.approx([0, 0, 0])
    assert np.array(across).ravel() * np.pi == pytest.approx([0.6, 0.7, 0.3], abs=1e-5)
