"""`dnrpipe batch`: many scenes, unattended."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .options import EXECUTOR_OPTIONS, OUTPUT_OPTIONS, executor_assignments, options


@click.command()
@click.argument("fleet", type=click.Path(path_type=Path))
@click.option(
    "--jobs",
    type=click.IntRange(1, 1000),
    metavar="N",
    help="Scenes side by side (default 1; on a Ray cluster 8). Each uses all cores that it finds free.",
)
@click.option("--resume/--no-resume", default=True, help="Go on where it stopped (default), or do all again.")
@options([*EXECUTOR_OPTIONS, *OUTPUT_OPTIONS])
def batch(fleet: Path, jobs: int | None, resume: bool, as_json: bool, quiet: bool, **more: Any) -> None:
    """Run many scenes, each with each variant of the settings, as fleet.toml says (docs/scaling.md).

    A scene that fails stops no other. Exit code 1 where one did; its line says which command, and why. The folder of
    the fleet has the workspaces, a log each, fleet.json and index.html.

    \b
    Examples:
      dnrpipe batch fleet.toml
      dnrpipe batch fleet.toml --jobs 2 --json
      dnrpipe batch fleet.toml --executor ray --address auto
    """
    from ..core.console import Console
    from ..fleet.page import table, told
    from ..fleet.plan import read_fleet
    from ..fleet.run import run_fleet
    from ..workers.view_tasks import TasksFailed

    console = Console(json_mode=as_json, quiet=quiet)
    plan = read_fleet(fleet)
    on_ray = more["executor"] == "ray"
    if on_ray:  # one cluster for all commands
        from ..core.settings import ExecutorSettings
        from ..workers.ray_workers import address_of

        more["address"] = address_of(ExecutorSettings(engine="ray", address=more["address"] or "local"))
    flags = [word for setting in executor_assignments(more) for word in ("--set", setting)]
    summary = run_fleet(plan, jobs=jobs or (8 if on_ray else 1), more=flags, force=not resume, console=console)
    console.say(table(summary))
    console.say(f"{told(summary, len(plan.jobs))}: {plan.out / 'index.html'}")
    console.result(summary.model_dump(mode="json"))
    if summary.failed:
        names = ", ".join(row.name for row in summary.failed)
        raise TasksFailed(f"batch: {names} failed; see {plan.out / 'logs'}")
