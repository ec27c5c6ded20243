"""`dnrpipe batch`: many scenes, unattended."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..core.errors import UserError
from .options import EXECUTOR_OPTIONS, OUTPUT_OPTIONS, executor_assignments, options

if TYPE_CHECKING:
    from ..core.console import Console
    from ..fleet.plan import Fleet


ON_RAY = 8
"""Scenes side by side on a cluster: the driver converts them and waits for the rest."""


@click.command()
@click.argument("fleet", type=click.Path(path_type=Path))
@click.option(
    "--jobs",
    type=click.IntRange(1, 1000),
    metavar="N",
    help="Scenes side by side (default 1; on a Ray cluster 8). Each uses all cores that it finds free.",
)
@click.option("--resume/--no-resume", default=True, help="Go on where it stopped (default), or do all again.")
@click.option(
    "--forecast",
    metavar="N,M",
    help="Only say what the fleet would take on so many nodes like this machine (and --jobs), by what its finished"
    " scenes took.",
)
@options([*EXECUTOR_OPTIONS, *OUTPUT_OPTIONS])
def batch(
    fleet: Path, jobs: int | None, resume: bool, forecast: str | None, as_json: bool, quiet: bool, **more: Any
) -> None:
    """Run many scenes, each with each variant of the settings, as fleet.toml says (docs/scaling.md).

    A scene that fails stops no other. Exit code 1 where one did; its line says which command, and why. The folder of
    the fleet has the workspaces, a log each, fleet.json and index.html.

    \b
    Examples:
      dnrpipe batch fleet.toml
      dnrpipe batch fleet.toml --jobs 2 --json
      dnrpipe batch fleet.toml --executor ray --address auto
      dnrpipe batch fleet.toml --forecast 1,8,64       # once some of its scenes are done
    """
    from ..core.console import Console
    from ..fleet.page import table, told
    from ..fleet.plan import read_fleet
    from ..fleet.run import run_fleet
    from ..workers.view_tasks import TasksFailed

    console = Console(json_mode=as_json, quiet=quiet)
    plan = read_fleet(fleet)
    if forecast is not None:
        _tell_forecast(plan, forecast, jobs or ON_RAY, console)
        return
    on_ray = more["executor"] == "ray"
    if on_ray:  # one cluster for all commands
        from ..core.settings import ExecutorSettings
        from ..workers.ray_workers import address_of

        more["address"] = address_of(ExecutorSettings(engine="ray", address=more["address"] or "local"))
    # By the environment: a cluster's address is this run's, not the workspaces'.
    given = (setting.partition("=") for setting in executor_assignments(more))
    environment = {f"DNRPIPE_{key.upper().replace('.', '__')}": value for key, _, value in given}
    at_once = jobs or (ON_RAY if on_ray else 1)
    summary = run_fleet(plan, jobs=at_once, environment=environment, force=not resume, console=console)
    console.say(table(summary))
    console.say(f"{told(summary, len(plan.jobs))}: {plan.out / 'index.html'}")
    console.result(summary.model_dump(mode="json"))
    if summary.failed:
        names = ", ".join(row.name for row in summary.failed)
        raise TasksFailed(f"batch: {names} failed; see {plan.out / 'logs'}")


def _tell_forecast(plan: Fleet, nodes: str, jobs: int, console: Console) -> None:
    from ..core.ledger import Ledger
    from ..core.units import duration
    from ..fleet.forecast import chain_of, forecast
    from ..fleet.records import read_rows
    from ..workers.view_tasks import worker_count

    try:
        counts = sorted({int(part) for part in nodes.split(",")})
    except ValueError:
        counts = []
    if not counts or counts[0] < 1:
        raise UserError(f"--forecast {nodes}: name numbers of nodes, for example 1,8,64")
    finished = {row.name for row in read_rows(plan.out) if row.state == "done"}
    ledgers = [Ledger(job.workspace / "costs.jsonl") for job in plan.jobs if job.name in finished]
    if not ledgers:
        raise UserError(f"--forecast: no scene of {plan.out} is done yet; run some of them first")
    slots = worker_count(0)
    chains = [chain_of(ledger.read()) for ledger in ledgers]
    found = {count: forecast(chains, len(plan.jobs), count, slots=slots, drivers=jobs) for count in counts}
    console.say(
        f"{len(plan.jobs)} scenes, {jobs} at once, by the costs of {len(ledgers)}; nodes of {slots} tasks side by side:"
    )
    for count, seconds in found.items():
        console.say(f"  {count:>4} nodes  {duration(seconds)}")
    console.result({"scenes": len(plan.jobs), "known": len(ledgers), "seconds": found})
