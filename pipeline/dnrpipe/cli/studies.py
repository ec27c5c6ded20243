"""`dnrpipe ablate` and `dnrpipe bench-select`: variants of the renderer, and policies of selection, side by side."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .options import EXECUTOR_OPTIONS, executor_assignments, options

SCENES = click.option(
    "--scenes", metavar="A,B", help="Scene files, or names of blender_scenes/ (default: its ten scenes)."
)
PRESET = click.option(
    "--preset", default="draft", show_default=True, metavar="NAME",
    help="draft, standard, paper, or paper-128: its schedule on pictures of 128x128.",
)  # fmt: skip
JOBS = click.option(
    "--jobs", type=int, default=0, metavar="N", help="Cells side by side (default: one per core; 1 on a GPU)."
)
JSON = click.option("--json", "as_json", is_flag=True, help="Print results.json; messages to stderr.")
FIRST_SEED = click.option(
    "--first-seed", type=click.IntRange(min=0), default=0, show_default=True, metavar="N",
    help="Seeds count from here: each machine may take some.",
)  # fmt: skip
EXECUTOR = options(EXECUTOR_OPTIONS)
QUIET = click.option("-q", "--quiet", is_flag=True, help="Warnings and errors only.")


@click.command()
@SCENES
@click.option(
    "--rows",
    metavar="A,B",
    help="Rows or groups: core (default), paper-table, paper-more, fig7a, fig7b, fig7c, ingredients, all, vanilla, ...",
)
@click.option("--seeds", type=int, default=3, show_default=True, metavar="N", help="Every row is trained N times.")
@FIRST_SEED
@PRESET
@click.option("--budget", type=int, metavar="M", help="Training views (default 25).")
@click.option(
    "--seconds", type=float, metavar="S", help="Train every row for about S seconds, not the preset's epochs."
)
@JOBS
@click.option("--set", "assignments", multiple=True, metavar="KEY=VALUE", help="A setting of all rows. Repeatable.")
@click.option(
    "--out", type=click.Path(path_type=Path), default=Path("ablation"), show_default=True, metavar="DIR",
    help="Workspaces, cells, results.json, tables.md, plot.png and pictures/ go here.",
)  # fmt: skip
@click.option("--smoke", is_flag=True, help="One small scene, two rows, few epochs: shows that it works.")
@EXECUTOR
@JSON
@QUIET
def ablate(as_json: bool, quiet: bool, out: Path, **given: Any) -> None:
    """Train variants of the neural renderer on the same scenes and views, and tabulate them.

    Scenes are prepared and their views ray-traced once. A cell (scene, row, seed) that is done is not done again:
    an interrupted run goes on where it stopped, and further rows or seeds add to what is there.

    \b
    Examples:
      dnrpipe ablate --seeds 2 --seconds 60
      dnrpipe ablate --scenes materials,interior --rows ingredients --seeds 1
      dnrpipe ablate --scenes my.blend --rows vanilla,dnr --out my-ablation
    """
    from ..core.console import Console
    from ..studies.ablation.ablate import run_ablation

    console = Console(json_mode=as_json, quiet=quiet)
    given["assignments"] = (*executor_assignments(given), *given["assignments"])
    results = run_ablation(out=out, console=console, **given)
    console.say(f"{len(results['cells'])} cells: {out / 'tables.md'}, {out / 'plot.png'}, {out / 'pictures'}")
    console.result(results)


@click.command("bench-select")
@SCENES
@click.option("--pools", metavar="A,B", help="Candidates: dome, sphere, path, indoor, all (default).")
@click.option("--budgets", metavar="N,M", help="Numbers of views (default 10,25), or full: 5 to 30 by 5, then by 10.")
@click.option(
    "--policies", metavar="A,B",
    help="Policies or groups: core (default: all that need no training), simple, rewards, all, random, rl-paper, ...",
)  # fmt: skip
@click.option("--seeds", type=int, default=3, show_default=True, metavar="N", help="Every cell is trained N times.")
@FIRST_SEED
@click.option("--views", type=int, metavar="N", help="Candidates in every pool (default 100).")
@PRESET
@click.option(
    "--seconds", type=float, metavar="S", help="Train every cell for about S seconds, not the preset's epochs."
)
@click.option("--steps", type=int, metavar="N", help="N steps of step 2, whatever the budget, not the preset's epochs.")
@JOBS
@click.option("--set", "assignments", multiple=True, metavar="KEY=VALUE", help="A setting of all cells. Repeatable.")
@click.option(
    "--out", type=click.Path(path_type=Path), default=Path("bench-select"), show_default=True, metavar="DIR",
    help="Workspaces, selections, cells, results.json, report.md, views.png and seconds.png go here.",
)  # fmt: skip
@click.option("--smoke", is_flag=True, help="One small scene, two pools, few epochs: shows that it works.")
@EXECUTOR
@JSON
@QUIET
def bench_select(as_json: bool, quiet: bool, out: Path, **given: Any) -> None:
    """Let policies choose views from the same candidates, train the same model on them, and compare.

    Pools are prepared once, views are ray-traced once, when some policy chooses them. A cell (scene, pool, budget,
    policy, seed) that is done is not done again: an interrupted run goes on where it stopped, and further policies,
    budgets or seeds add to what is there.

    \b
    Examples:
      dnrpipe bench-select --seconds 15
      dnrpipe bench-select --scenes interior,ship --pools path,indoor --policies simple,auto --seeds 5 --seconds 15
      dnrpipe bench-select --scenes my.blend --pools dome --budgets full --policies all --out my-bench
    """
    from ..core.console import Console
    from ..studies.selectbench.bench_select import run_bench

    console = Console(json_mode=as_json, quiet=quiet)
    given["assignments"] = (*executor_assignments(given), *given["assignments"])
    results = run_bench(out=out, console=console, **given)
    console.say(f"{len(results['cells'])} cells: {out / 'report.md'}, {out / 'views.png'}, {out / 'seconds.png'}")
    console.result(results)
