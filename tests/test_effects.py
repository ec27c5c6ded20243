"""The effect plan: what turns an effect on, with which evidence, and what the user may override. Pure functions."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.scene_records import CAMERA, MATT, scene_census, scene_summary

from dnrpipe.core.cameras import view_lenses
from dnrpipe.core.effect_names import FORCEABLE, NAMES, NEURAL
from dnrpipe.core.errors import UserError
from dnrpipe.core.settings import CameraSettings, Settings, resolve
from dnrpipe.effects.bundle import bundle_facts, write_without
from dnrpipe.effects.plan import DepthPilot, EffectPlan, plan_effects
from dnrpipe.raytrace.statistics import DepthStep, difference, enough, remaining, significance
from dnrpipe.stages.base_images import LightPlan, light_plan
from dnrpipe.studies.effect_costs import override_settings, table
from dnrtrain.settings import ModelSettings

GLASS = MATT | {
    "glossy": True,
    "transmissive": True,
    "refractive": True,
    "ior": 1.5,
    "min_roughness": 0.0,
    "objects": ["Ball"],
}


def pilot(depth: int, bounced: float = 0.025) -> DepthPilot:
    """bounced: share of the light that direct light alone would miss."""
    steps = tuple(DepthStep(depth=d, mean=bounced if d < depth else 0.001, mean_error=0, pixel=0) for d in (2, depth))
    return DepthPilot(
        fingerprint="f",
        max_depth=depth,
        reference_depth=64,
        tolerance=0.005,
        pixel_tolerance=0.02,
        views=4,
        resolution=96,
        spp=16,
        seconds=1.0,
        steps=steps,
    )


def test_how_light_is_baked() -> None:
    """By what has bounced, and by the size of the images; the user's word goes first."""
    sunny, indoors = (plan_effects(scene_census(), {}, pilot=pilot(6, bounced)) for bounced in (0.2, 0.5))

    def of(side: int, plan: EffectPlan = sunny, **base: object) -> LightPlan:
        size = {"width": side, "height": side // 2}
        return light_plan(resolve("draft", {"cameras": size, "base": base}, environment={}), plan)

    sizes = [(of(side).size, of(side, indoors).size) for side in (32, 64, 128, 256, 640, 4096)]
    assert sizes == [(256, 256), (512, 512), (1024, 1024), (1024, 1024), (2048, 1024), (4096, 4096)]
    assert of(128) == LightPlan(gathered=False, size=1024, spp=16)
    assert of(128, indoors) == LightPlan(gathered=True, size=1024, spp=32)
    assert of(128, indoors, light="traced", light_size=300, light_spp=7) == LightPlan(gathered=False, size=300, spp=7)
    assert of(128, plan_effects(scene_census(), {}, max_depth=9)) == of(128)  # nobody measured it
    assert of(640, indoors).paths < 0.4 * of(640).paths
    settings = resolve("draft", {"cameras": {"width": 128, "height": 128}}, environment={})
    assert light_plan(settings, sunny, fine=True) == LightPlan(gathered=False, size=2048, spp=16)


def on(plan: EffectPlan) -> set[str]:
    return {effect.name for effect in plan.effects if effect.on}


def test_a_matt_scene_calls_for_indirect_light_alone() -> None:
    plan = plan_effects(scene_census(), {})
    assert on(plan) == {"indirect"}
    assert plan.max_depth is None and plan.integrator == "path"
    assert all(effect.evidence and all(effect.evidence) for effect in plan.effects)


def test_the_pilot_decides_depth_and_indirect_light() -> None:
    deep = plan_effects(scene_census(), {}, pilot=pilot(6))
    assert (deep.integrator, deep.max_depth, deep.depth_by) == ("path", 6, "pilot")
    shallow = plan_effects(scene_census(), {}, pilot=pilot(2))
    assert (shallow.integrator, shallow.max_depth) == ("direct", 2) and not shallow.on("indirect")
    fixed = plan_effects(scene_census(), {}, max_depth=9, pilot=pilot(2))
    assert (fixed.max_depth, fixed.depth_by) == (9, "settings")
    black = plan_effects(
        scene_census(materials={"Lamp": MATT | {"reflects": False, "emissive": True}}), {"glow": ["a"]}
    )
    assert (black.integrator, black.max_depth, black.depth_by) == ("direct", 2, "scene")
    assert on(black) == {"glow"}


def test_evidence_names_material_object_lamp_and_camera() -> None:
    lamps = [
        {"name": "Bulb", "type": "POINT", "power": 10.0, "color": [1, 1, 1], "size": 0.1},
        {"name": "Spark", "type": "SPOT", "power": 5.0, "color": [1, 1, 1], "size": 0.0},
        {"name": "Off", "type": "POINT", "power": 0.0, "color": [1, 1, 1], "size": 0.1},
    ]
    world = {"name": "Sky", "kind": "sky", "image": None, "emits": True, "volume": False, "nodes": {}}
    held = {"refraction": ["mat-Glass"], "environment": ["w"], "area-lights": ["l1"], "point-lights": ["l2"]}
    plan = plan_effects(
        scene_census(materials={"Chalk": MATT, "Glass": GLASS}, lights=lamps, world=world), held, lenses=("Close-up",)
    )
    wanted = {"refraction": ["'Glass'", "'Ball'", "1.5"], "caustics": ["'Glass'"], "environment": ["'Sky'"]}
    wanted |= {"area-lights": ["'Bulb'"], "point-lights": ["'Spark'"], "depth-of-field": ["'Close-up'"]}
    wanted |= {"view-dependence": ["'Glass'"], "depth": ["'Glass'"], "normal": ["'Glass'"]}
    assert on(plan) == {"indirect", *wanted}
    for name, words in wanted.items():
        text = " ".join(plan.effect(name).evidence)  # type: ignore[arg-type]
        assert all(word in text for word in words), (name, text)
        assert "Off" not in text


def test_what_the_converted_scene_does_not_hold_is_off_and_says_so() -> None:
    plan = plan_effects(scene_census(materials={"Fog": MATT | {"volume": True}}, hair=["Fur"]), {})
    assert not plan.on("volumes") and not plan.on("hair")
    assert "inspect" in plan.effect("volumes").evidence[0] and "'Fog'" in plan.effect("volumes").evidence[1]


def test_integrator_follows_the_plan() -> None:
    glass = scene_census(materials={"Chalk": MATT, "Glass": GLASS})
    assert plan_effects(glass, {"volumes": ["m"]}).integrator == "volpath"
    assert plan_effects(glass, {}, disable=["caustics"]).integrator == "path-without-caustics"
    # `direct` stops at null surfaces: cut-outs keep `path`.
    assert plan_effects(scene_census(), {"alpha": ["m"]}, max_depth=2).integrator == "path"
    assert plan_effects(scene_census(), {"alpha": ["m"], "point-lights": ["m"]}).integrator == "path"
    assert plan_effects(scene_census(), {"null": ["m"]}, max_depth=2).integrator == "path"
    kept = plan_effects(glass, {"volumes": ["m"]}, disable=["caustics"])
    assert kept.on("caustics") and kept.integrator == "volpath"


def test_instances_that_share_a_place_keep_depth_and_normal() -> None:
    plan = plan_effects(scene_census(instances=50, meshes=2), {})
    assert plan.on("depth") and plan.on("normal") and not plan.on("view-dependence")


def test_the_neural_renderer_loses_what_is_off_and_gains_nothing() -> None:
    plain = plan_effects(scene_census(), {})
    model = plain.model(ModelSettings())
    assert (model.modalities, model.spherical_harmonics) == ("uv", False)
    shiny = plan_effects(scene_census(materials={"Glass": GLASS}), {"refraction": ["m"]})
    assert shiny.model(ModelSettings()) == ModelSettings()
    own = ModelSettings(modalities="uv+normal", spherical_harmonics=False)
    assert shiny.model(own) == own


BUNDLE_NAMES = ("refraction", "volumes", "subsurface", "alpha", "environment", "area-lights", "point-lights", "glow")


@settings(deadline=None, max_examples=150)
@given(
    st.sets(st.sampled_from(BUNDLE_NAMES)),
    st.sets(st.sampled_from(NAMES)),
    st.sets(st.sampled_from(NAMES)),
    st.sampled_from(["auto", 1, 2, 7]),
    st.one_of(st.none(), st.sampled_from([2, 4, 12])),
)
def test_overrides_are_obeyed_or_have_nothing_to_act_on(
    held: set[str], enable: set[Any], disable: set[Any], depth: Any, piloted: int | None
) -> None:
    scene = scene_census(materials={"Chalk": MATT, "Glass": GLASS})
    bundle = {name: ["x"] for name in held}
    arguments: dict[str, Any] = {"max_depth": depth, "pilot": None if piloted is None else pilot(piloted)}
    plan = plan_effects(scene, bundle, enable=sorted(enable), disable=sorted(disable), **arguments)
    assert plan == plan_effects(scene, bundle, enable=sorted(enable), disable=sorted(disable), **arguments)
    assert EffectPlan.model_validate_json(plan.model_dump_json()) == plan
    for effect in plan.effects:
        if effect.name in disable and effect.on:
            assert not effect.present  # there is no way to leave it out
        elif effect.name in enable - disable and not effect.on:
            assert not effect.present or (effect.name == "indirect" and depth in (1, 2))
            assert effect.name not in FORCEABLE - {"indirect"}
    assert set(plan.left_out) <= set(disable) and not set(plan.left_out) & NEURAL
    assert (plan.integrator == "volpath") == plan.on("volumes")
    if plan.max_depth is None:
        assert depth == "auto" and piloted is None
    table(plan)


def test_flags_replace_each_other_and_unknown_names_are_refused() -> None:
    before = resolve(None, {"effects": {"enable": ["volumes"], "disable": ["caustics"]}}, environment={})
    change = override_settings(("caustics",), ("volumes",), ())
    assert change(before)["effects"] == {"enable": ["caustics"], "disable": ["volumes"]}
    assert override_settings((), (), ("volumes",))(before)["effects"]["enable"] == []
    assert override_settings((), (), ())(before) == {}
    with pytest.raises(UserError, match="no effect 'vollumes'"):
        override_settings(("vollumes",), (), ())
    with pytest.raises(UserError, match="give one of them"):
        override_settings(("glow",), ("glow",), ())
    with pytest.raises(UserError, match="effects"):
        resolve(None, {"effects": {"disable": ["fog"]}}, environment={})


def test_an_override_makes_stale_only_what_it_touches() -> None:
    from dnrpipe.stages.pipeline import STAGES

    def told(stage: str, **effects: Any) -> Any:
        chosen = {"effects": effects, "select": {"policy": "rl-paper"}}  # which trains a model
        return STAGES[stage].settings(resolve(None, chosen, environment={}))

    for stage, touched in (("select", False), ("finetune", False), ("raytrace", True), ("evaluate", True)):
        assert (told(stage, disable=["caustics"]) != told(stage)) == touched
        assert (told(stage, disable=["normal"]) != told(stage)) != touched
    assert told("raytrace", tolerance=0.01) != told("raytrace")


def test_the_help_names_every_effect() -> None:
    from dnrpipe.cli.information import effects

    named = " ".join((effects.help or "").split()).partition("Names: ")[2].partition(".")[0]
    assert tuple(named.split(", ")) == NAMES


def test_max_depth_is_auto_or_a_number() -> None:
    assert Settings().raytrace.max_depth == "auto"
    assert resolve(None, {"raytrace": {"max_depth": 5}}, environment={}).raytrace.max_depth == 5
    for bad in (0, "deep"):
        with pytest.raises(UserError, match="max_depth"):
            resolve(None, {"raytrace": {"max_depth": bad}}, environment={})


BUNDLE = """<scene version="3.0.0">
  <emitter type="constant" id="world"/>
  <emitter type="directional" id="light-sun"/>
  <bsdf type="roughdielectric" id="mat-glass"><float name="alpha" value="0.1"/></bsdf>
  <bsdf type="mask" id="mat-leaf"><float name="opacity" value="0.5"/>
    <bsdf type="twosided"><bsdf type="diffuse"/></bsdf></bsdf>
  <bsdf type="principled" id="mat-skin">
    <float name="flatness" value="0.5"/><float name="spec_trans" value="0.0"/></bsdf>
  <shape type="rectangle" id="light-area"><emitter type="area"/></shape>
  <shape type="sphere" id="mesh-bulb"><emitter type="area"/><ref id="mat-glass"/></shape>
  <shape type="shapegroup" id="group-fur"><shape type="ply" id="hair-fur"/></shape>
  <shape type="instance"><ref id="group-fur"/></shape>
  <shape type="sphere" id="mesh-cloud"><medium type="homogeneous" name="interior"/></shape>
</scene>"""
HELD = {
    "refraction": ["mat-glass"],
    "alpha": ["mat-leaf"],
    "subsurface": ["mat-skin"],
    "volumes": ["homogeneous"],
    "environment": ["world"],
    "point-lights": ["light-sun"],
    "area-lights": ["light-area"],
    "glow": ["mesh-bulb"],
    "hair": ["hair-fur"],
}


def test_bundle_facts_find_every_effect(tmp_path: Path) -> None:
    (tmp_path / "scene.xml").write_text(BUNDLE)
    assert bundle_facts(tmp_path / "scene.xml") == HELD
    (tmp_path / "torn.xml").write_text("<scene")
    with pytest.raises(UserError, match="damaged"):
        bundle_facts(tmp_path / "torn.xml")


@pytest.mark.parametrize("wrapper", ["dnr_interface", "dnr_refraction"])
def test_without_refraction_what_corrects_a_dielectric_goes_too(wrapper: str, tmp_path: Path) -> None:
    (tmp_path / "scene.xml").write_text(
        f'<scene version="3.0.0"><bsdf type="{wrapper}" id="mat-glass"><float name="eta" value="1.4"/>'
        '<bsdf type="roughdielectric"><float name="alpha" value="0.1"/><float name="int_ior" value="1.4"/></bsdf>'
        "</bsdf></scene>"
    )
    assert "refraction" in bundle_facts(tmp_path / "scene.xml")
    write_without(tmp_path / "scene.xml", ["refraction"], tmp_path / "other.xml")
    (glass,) = ET.parse(tmp_path / "other.xml").getroot()
    assert (glass.get("type"), glass.get("id")) == ("thindielectric", "mat-glass")
    assert [child.get("name") for child in glass] == ["int_ior"]


@pytest.mark.parametrize("name", sorted(set(HELD) - {"volumes"}))
def test_leaving_one_effect_out_keeps_the_others(tmp_path: Path, name: str) -> None:
    (tmp_path / "scene.xml").write_text(BUNDLE)
    write_without(tmp_path / "scene.xml", [name], tmp_path / "less.xml")
    assert bundle_facts(tmp_path / "less.xml") == {key: ids for key, ids in HELD.items() if key != name}
    assert ("group-fur" in (tmp_path / "less.xml").read_text()) == (name != "hair")


def _deep_and_missing(
    rng: np.random.Generator, share: float, noise: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    whole = np.full((4, 2, 64, 64, 3), 0.5)
    missing = share * whole * (1 + noise * rng.normal(size=whole.shape))
    return missing, whole, np.ones(whole.shape[:-1])


def test_remaining_light_is_measured_without_the_noise_choosing_itself() -> None:
    rng = np.random.default_rng(0)
    step = remaining(4, *_deep_and_missing(rng, 0.01, 5.0))
    assert step.mean == pytest.approx(0.01, rel=0.1)
    assert abs(step.mean - 0.01) < 4 * step.mean_error
    # The largest 2% of noisy blocks would be 3 times too high had they been chosen by what is measured.
    assert step.pixel == pytest.approx(0.01, rel=0.5)
    assert not enough(step, 0.005, 0.02) and enough(step, 0.02, 0.02)


def test_the_worst_pixels_decide_too() -> None:
    missing, whole, cover = _deep_and_missing(np.random.default_rng(1), 0.0, 0.0)
    missing[:, :, :12, :12] = 0.1
    step = remaining(4, missing, whole, cover)
    assert step.mean == pytest.approx(0.2 * 12 * 12 / 64**2) and step.pixel == pytest.approx(0.2)
    assert not enough(step, 0.5, 0.02)


def test_black_pictures_miss_nothing() -> None:
    zero = np.zeros((2, 2, 16, 16, 3))
    step = remaining(2, zero, zero, np.zeros(zero.shape[:-1]))
    assert (step.mean, step.mean_error, step.pixel) == (0, 0, 0)


def test_difference_is_free_of_noise() -> None:
    rng = np.random.default_rng(2)
    shape = (4, 2, 64, 64, 3)
    truth = np.full(shape, 0.4)
    noisy = [truth + rng.normal(0, 0.05, shape) for _ in range(2)]
    assert difference(*noisy).mean < 0.004 and abs(significance(*noisy)) < 4
    shifted = noisy[0] + 0.02
    assert difference(shifted, noisy[1]).mean == pytest.approx(0.02, rel=0.1) and significance(shifted, noisy[1]) > 10


def test_only_the_scenes_own_cameras_have_lenses() -> None:
    camera = CAMERA | {"name": "Main"}
    lens = {"aperture_radius": 0.01, "focus_distance": 3.0}
    summary = scene_summary(cameras=[camera | {"dof": lens}, camera | {"dof": None}])
    assert view_lenses(summary, CameraSettings(source="scene")) == {"Main": lens}
    assert view_lenses(summary, CameraSettings()) == {}
