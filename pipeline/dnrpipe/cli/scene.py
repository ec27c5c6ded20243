"""Commands about what is in a scene: `inspect` a file, and the `effects` of a workspace."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from .options import common, open_session


@click.command()
@click.argument("scene", type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Print the whole census and all findings as JSON.")
def inspect(scene: Path, as_json: bool) -> None:
    """Say what is in a scene file and what becomes of it, without a workspace.

    Lists by name what is converted exactly, approximated, baked into images, ignored or missing, and which
    light-transport effects the scene calls for. Nothing is written; embedded scripts are never executed.

    \b
    Examples:
      dnrpipe inspect scene.blend
      dnrpipe inspect scene.blend --json | jq .findings.ignored
    """
    from ..stages.inspect_scene import describe, inspect_scene

    found = inspect_scene(scene)
    click.echo(json.dumps(found.data(), indent=2) if as_json else describe(found))


@click.command()
@click.option("--measure", is_flag=True, help="Fill the cost and error columns from short paired renders.")
@click.option("--enable", multiple=True, metavar="NAME", help="Simulate an effect. Repeatable; remembered.")
@click.option("--disable", multiple=True, metavar="NAME", help="Leave an effect out. Repeatable; remembered.")
@click.option("--auto", multiple=True, metavar="NAME", help="Let the scene decide again. Repeatable.")
@common
def effects(
    measure: bool, enable: tuple[str, ...], disable: tuple[str, ...], auto: tuple[str, ...], **options: Any
) -> None:
    """Which effects are simulated for this scene, why, what each costs and what leaving it out would change.

    The ray tracer and the neural renderer follow this table. COST is what an effect adds to the time of a frame,
    ERROR the RMSE that leaving it out makes, both of this scene's own views, with 95% confidence; they are
    measured with --measure. The path depth comes from a pilot before the first ray-traced view.
    Overrides may also stand in dnrpipe.toml: [effects] disable = ["caustics"].

    Names: indirect, refraction, caustics, volumes, subsurface, alpha, environment, area-lights, point-lights, glow,
    hair, depth-of-field, spectral, motion, view-dependence, depth, normal.

    \b
    Examples:
      dnrpipe effects
      dnrpipe effects --measure
      dnrpipe effects --disable caustics --enable volumes
      dnrpipe effects --auto caustics
      dnrpipe effects --json | jq '.effects[] | select(.on) | .name'
    """
    from ..studies.effect_costs import override_settings, show_effects

    with open_session("effects", options, late=override_settings(enable, disable, auto)) as session:
        show_effects(session, measure=measure)
