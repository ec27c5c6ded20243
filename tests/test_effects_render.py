"""The tracer follows the plan, and the plan is right: effects it leaves off change nothing, those it keeps do.

One worker process renders small bundles written here; what is tested are its paired pilot renders.
"""

from __future__ import annotations

from typing import Any

import pytest
from tests.scene_records import sphere_summary

from dnrpipe.core.cameras import make_cameras
from dnrpipe.core.settings import CameraSettings
from dnrpipe.effects.bundle import write_without
from dnrpipe.raytrace.variants import choose_variant
from dnrpipe.workers.task_list import TaskResult, run_tasks

SUMMARY = sphere_summary((0.0, 0.0, 0.3), 1.5)
SIZE, SPP = 48, 64
SAME, DIFFERENT = 4.5, 8.0  # standard errors: chance of the first being passed by noise is 7e-6

DIFFUSE = '<bsdf type="diffuse"><rgb name="reflectance" value="0.7"/></bsdf>'
PLANE = f"""<shape type="rectangle"><transform name="to_world"><scale value="1.5"/></transform>
  <bsdf type="twosided">{DIFFUSE}</bsdf></shape>"""
LAMP = """<shape type="sphere" id="light-lamp"><point name="center" x="0.6" y="0.8" z="2.2"/>
  <float name="radius" value="0.12"/><emitter type="area"><rgb name="radiance" value="80"/></emitter></shape>"""


def ball(bsdf: str, extra: str = "") -> str:
    return f"""<shape type="sphere" id="mesh-ball"><point name="center" x="0" y="0" z="0.7"/>
  <float name="radius" value="0.5"/>{bsdf}{extra}</shape>"""


SCENES = {
    # A convex body alone: nothing bounces.
    "convex": '<emitter type="constant" id="world"/>' + ball(DIFFUSE),
    "matt": LAMP + PLANE + ball(DIFFUSE),
    # A broad lamp: caustics of a small one are found by so few paths that 64 samples show little of them.
    "glass": LAMP.replace("0.12", "0.5").replace('"80"', '"5"')
    + PLANE
    + ball('<bsdf type="dielectric" id="mat-glass"><float name="int_ior" value="1.5"/></bsdf>'),
    "leaf": LAMP + PLANE + ball(f'<bsdf type="mask" id="mat-leaf"><float name="opacity" value="0.4"/>{DIFFUSE}</bsdf>'),
    "bulb": LAMP + PLANE + ball(DIFFUSE, '<emitter type="area"><rgb name="radiance" value="2"/></emitter>'),
    "fog": LAMP
    + PLANE
    + ball(
        '<bsdf type="null"/>', '<medium type="homogeneous" name="interior"><float name="scale" value="3"/></medium>'
    ),
}
# Inside a closed diffuse shell that glows with radiance 1 paths see sum_{k<=n} albedo^k after n bounces: analytic.
ALBEDO = 0.3
SHELL = f"""<shape type="sphere" id="mesh-shell"><float name="radius" value="50"/>
  <boolean name="flip_normals" value="true"/>
  <bsdf type="diffuse"><rgb name="reflectance" value="{ALBEDO}"/></bsdf>
  <emitter type="area"><rgb name="radiance" value="1"/></emitter></shape>"""


@pytest.fixture(scope="module")
def answers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """Every comparison of this module, rendered by one worker."""
    folder = tmp_path_factory.mktemp("bundles")
    for name, body in {**SCENES, "shell": SHELL}.items():
        (folder / f"{name}.xml").write_text(f'<scene version="3.0.0">{body}</scene>')
    for name, effect in (("glass", "refraction"), ("leaf", "alpha"), ("bulb", "glow"), ("matt", "area-lights")):
        write_without(folder / f"{name}.xml", [effect], folder / f"{name}-less.xml")
    choice = choose_variant()
    views = make_cameras(SUMMARY, CameraSettings(train=2, val=0, test=0, width=SIZE, height=SIZE))["train"]
    entries = [{"view": view.model_dump(mode="json"), "lens": None} for view in views]
    blurred = [{**entry, "lens": {"aperture_radius": 0.2, "focus_distance": 3.0}} for entry in entries]
    pinholes = [{**entry, "lens": {"aperture_radius": 1e-6, "focus_distance": 3.0}} for entry in entries]

    def config(name: str, integrator: str = "path", depth: int = 8, lenses: bool = True) -> dict[str, Any]:
        bundle = str(folder / f"{name}.xml")
        return {
            "bundle": bundle,
            "integrator": integrator,
            "max_depth": depth,
            "variant": choice.variant,
            "lenses": lenses,
        }

    def compare(a: dict[str, Any], b: dict[str, Any], views: list[dict[str, Any]] = entries) -> dict[str, Any]:
        return {"kind": "compare", "with_effect": a, "without_effect": b, "views": views, "spp": SPP}

    tasks = {
        "volpath": compare(config("matt", "volpath"), config("matt")),
        "depth": compare(config("convex", depth=64), config("convex", "direct")),
        "direct": compare(config("matt", depth=2), config("matt", "direct")),
        "caustics-matt": compare(config("matt"), config("matt", "path-without-caustics")),
        "bulb-matt": compare(config("bulb"), config("bulb", "path-without-caustics")),
        "own-glass": compare(config("glass"), config("glass", "path-of-any-depth")),
        "pinhole": compare(config("matt"), config("matt", lenses=False), pinholes),
        "indirect": compare(config("matt"), config("matt", "direct")),
        "caustics": compare(config("glass"), config("glass", "path-without-caustics")),
        "refraction": compare(config("glass"), config("glass-less")),
        "alpha": compare(config("leaf"), config("leaf-less")),
        "glow": compare(config("bulb"), config("bulb-less")),
        "area-lights": compare(config("matt"), config("matt-less")),
        "volumes": compare(config("fog", "volpath"), config("fog")),
        "depth-of-field": compare(config("matt"), config("matt", lenses=False), blurred),
    }
    pilot = {"kind": "depth", "views": entries, "spp": 16, "tolerance": 0.005, "pixel_tolerance": 0.02}
    tasks["pilot-convex"] = {**pilot, "config": config("convex")}
    tasks["pilot-shell"] = {**pilot, "config": config("shell")}
    # Cameras of our own plugin, side by side as the others are: of a lens, and of pixels that are no squares.
    oblong = [{**entry, "view": {**entry["view"], "fl_y": 1.1 * entry["view"]["fl_y"]}} for entry in blurred]
    tasks["pilot-shell-lens"] = {**pilot, "config": config("shell"), "views": oblong}
    configs = [
        task[key] for task in tasks.values() for key in ("with_effect", "without_effect", "config") if key in task
    ]
    named = [{**task, "name": name} for name, task in tasks.items()]
    outcomes = run_tasks(
        "dnrpipe.raytrace.pilot",
        {"configs": configs},
        named,
        workers=1,
        log=folder / "log",
        environment=choice.environment,
    )
    done = [o for o in outcomes if isinstance(o, TaskResult)]
    assert all(o.result for o in done), [o.error for o in done]
    return {o.task["name"]: o.result for o in done if o.result}


@pytest.mark.parametrize("name", ["volpath", "depth", "direct", "caustics-matt", "bulb-matt", "own-glass", "pinhole"])
def test_an_effect_that_nothing_calls_for_changes_no_pixel_beyond_noise(answers: dict[str, Any], name: str) -> None:
    assert abs(answers[name]["significance"]) < SAME, answers[name]
    assert answers[name]["error"]["mean"] < 0.01


def test_simulating_it_all_the_same_costs_time(answers: dict[str, Any]) -> None:
    assert answers["volpath"]["seconds_with"] > 1.05 * answers["volpath"]["seconds_without"]


@pytest.mark.parametrize(
    "name",
    ["indirect", "caustics", "refraction", "alpha", "glow", "area-lights", "volumes", "depth-of-field"],
)
def test_leaving_out_an_effect_that_the_scene_calls_for_changes_the_picture(answers: dict[str, Any], name: str) -> None:
    assert answers[name]["significance"] > DIFFERENT, answers[name]
    assert answers[name]["error"]["mean"] > 0.005


def test_nothing_bounces_off_a_convex_body_alone(answers: dict[str, Any]) -> None:
    assert answers["pilot-convex"]["max_depth"] == 2


@pytest.mark.parametrize("name", ["pilot-shell", "pilot-shell-lens"])
def test_the_pilot_finds_the_analytic_depth_of_a_furnace(answers: dict[str, Any], name: str) -> None:
    """What d bounces leave out is albedo^(d + 1): 0.3^4 = 0.8% is too much, 0.3^5 = 0.2% is enough.

    (The glowing surface that the camera itself sees is one more vertex than the depth counts.)
    """
    answer = answers[name]
    assert answer["max_depth"] == 4
    for step in answer["steps"]:
        if step["depth"] <= 4:
            assert step["mean"] == pytest.approx(ALBEDO ** (step["depth"] + 1), rel=0.1), step
