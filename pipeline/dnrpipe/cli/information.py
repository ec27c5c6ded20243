"""Commands that look and tell: inspect, effects, status, verify, costs, doctor, weights."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from ..core.console import Console, clock
from ..core.errors import UserError
from .options import WORKSPACE, common, open_session, print_json

JSON = click.option("--json", "as_json", is_flag=True, help="Print JSON.")


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
    if as_json:
        print_json(found.data())
    else:
        click.echo(describe(found))


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


@click.command()
@WORKSPACE
@JSON
def status(workspace: str | None, as_json: bool) -> None:
    """Show what is done, partial, stale or missing, and the next command.

    \b
    Examples:
      dnrpipe status
      dnrpipe status --json
    """
    from ..core.workspace import Workspace, find_workspace
    from ..stages.pipeline import status as status_of
    from ..stages.session import resolve_settings

    found = Workspace.open(find_workspace(workspace))
    rows = status_of(found, resolve_settings(found, {}, None))
    if as_json:
        print_json({"workspace": str(found.root), "stages": [asdict(row) for row in rows]})
        return
    click.echo(f"{found.root}  (from {found.manifest.source.path})")
    for row in rows:
        took = clock(row.seconds) if row.seconds is not None else "-"
        click.echo(f"  {row.state:8} {row.command:18} {row.present:>4}/{row.wanted:<4} {took:>7}  {row.does}")
    due = next((row for row in rows if row.state != "done"), None)
    click.echo(f"next: dnrpipe {due.command}" if due else "next: dnrpipe render --orbit 60, or dnrpipe report")


@click.command()
@click.argument("workspace", required=False)
@click.option("-w", "--workspace", "named", metavar="DIR", help="The workspace folder (scene.dnr).")
@click.option("--repair", is_flag=True, help="Throw away what is damaged; the stages named make it again.")
@JSON
def verify(workspace: str | None, named: str | None, repair: bool, as_json: bool) -> None:
    """Read every file of a workspace and compare it with what was written.

    Exit code 1 when something is damaged and --repair was not given. Stages notice damage themselves when they read
    a file, and make it again; this command looks at all files at once.

    \b
    Examples:
      dnrpipe verify
      dnrpipe verify scene.dnr --repair
      dnrpipe verify --json | jq .faults
    """
    from ..core.workspace import Workspace, find_workspace, locked
    from ..stages.verify import examine
    from ..stages.verify import repair as discard_damaged

    console = Console(json_mode=as_json)
    root = find_workspace(named or workspace)
    Workspace.open(root)
    with ExitStack() as stack:
        if repair:
            stack.enter_context(locked(root, "verify"))
        found = Workspace.open(root)
        checked, faults = examine(found, console)
        due = discard_damaged(found, faults) if repair else []
    if as_json:
        rows = [{"file": str(f.path), "reason": f.reason, "stage": f.stage, "leftover": f.leftover} for f in faults]
        print_json({"workspace": str(root), "checked": checked, "faults": rows, "due": due})
    else:
        for fault in faults:
            click.echo(f"{fault.path}: {fault.reason}")
        kept = sum(fault.path.exists() for fault in faults)
        gone = f", {len(faults) - kept} thrown away, {kept} kept: no stage makes them" if repair and faults else ""
        click.echo(f"{checked} files checked, {len(faults)} with a fault{gone}")
        if due:
            click.echo("next: " + ", ".join(f"dnrpipe {command}" for command in due))
        elif faults and not repair:
            click.echo("next: dnrpipe verify --repair")
    if faults and not repair:
        raise SystemExit(1)


@click.command()
@WORKSPACE
@JSON
def costs(workspace: str | None, as_json: bool) -> None:
    """Sum the ledger: where the time went.

    \b
    Examples:
      dnrpipe costs
      dnrpipe costs --json | jq .
    """
    from ..core.ledger import CostSum, summarise
    from ..core.workspace import Workspace, find_workspace

    found = Workspace.open(find_workspace(workspace))
    prepared, raytraced = found.manifest.prepared, found.manifest.raytraced
    summary = summarise(
        found.ledger.read(),
        n_candidates=prepared.views["train"] if prepared else None,
        only={f"train/{name}" for name in raytraced.views} if raytraced else None,
        truncated_records=found.ledger.truncated_records(),
    )
    if as_json:
        print_json(summary.model_dump())
        return

    def columns(part: CostSum) -> str:
        return f"{part.records:>6} {clock(part.wall_seconds):>8} {clock(part.cpu_seconds):>8}"

    click.echo(f"{'stage':10} {'for':12} {'units':>6} {'wall':>8} {'cpu':>8}")
    for stage, purposes in summary.by_stage_and_purpose.items():
        for purpose, part in purposes.items():
            click.echo(f"{stage:10} {purpose:12} {columns(part)}")
    click.echo(f"{'total':23} {columns(summary.total)}")
    if tracing := summary.tracing_all:
        click.echo(
            f"ray-traced {tracing.views} of {tracing.candidates} candidates in {tracing.actual_seconds:.1f} s;"
            f" all would have cost {tracing.all_seconds:.1f} s"
        )


@click.command()
@JSON
def doctor(as_json: bool) -> None:
    """Check this machine: Blender, EEVEE, Mitsuba variants, torch, weights, disk.

    \b
    Examples:
      dnrpipe doctor
      dnrpipe doctor --json
    """
    from .doctor import examine

    checks = examine()
    if as_json:
        print_json(checks)
    else:
        for check in checks:
            click.echo(f"{check['state']:5} {check['name']:18} {check['text']}")
    if any(check["state"] == "fail" for check in checks):
        raise SystemExit(1)


@click.command()
@click.option("--offline", is_flag=True, help="Only check what is cached.")
@JSON
def weights(offline: bool, as_json: bool) -> None:
    """Fetch the VGG16, AlexNet and LPIPS weights into the cache (~/.cache/dnrpipe or DNRPIPE_CACHE).

    Needed for the perceptual loss and LPIPS. Without them, training says so and drops both.

    \b
    Examples:
      dnrpipe weights
      dnrpipe weights --offline
    """
    from dnrtrain.weights import WeightsMissing, ensure_weights

    try:
        found = ensure_weights(offline=offline)
    except WeightsMissing as error:
        raise UserError(str(error)) from None
    if as_json:
        print_json(found)
    else:
        click.echo("\n".join(f"{k}: {v}" for k, v in found.items()))
