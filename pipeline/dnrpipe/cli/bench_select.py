"""`dnrpipe bench-select`: policies of view selection side by side."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click


@click.command("bench-select")
@click.option("--scenes", metavar="A,B", help="Scene files, or names of blender_scenes/ (default: its ten scenes).")
@click.option("--pools", metavar="A,B", help="Candidates: dome, sphere, path, indoor, all (default).")
@click.option("--budgets", metavar="N,M", help="Numbers of views (default 10,25), or full: 5 to 30 by 5, then by 10.")
@click.option(
    "--policies", metavar="A,B",
    help="Policies or groups: core (default: all that need no training), simple, rewards, all, random, rl-paper, ...",
)  # fmt: skip
@click.option("--seeds", type=int, default=3, show_default=True, metavar="N", help="Every cell is trained N times.")
@click.option("--views", type=int, metavar="N", help="Candidates in every pool (default 100).")
@click.option("--preset", default="draft", show_default=True, metavar="NAME", help="draft, standard or paper.")
@click.option(
    "--seconds", type=float, metavar="S", help="Train every cell for about S seconds, not the preset's epochs."
)
@click.option(
    "--jobs", type=int, default=0, metavar="N", help="Cells side by side (default: one per core; 1 on a GPU)."
)
@click.option("--set", "assignments", multiple=True, metavar="KEY=VALUE", help="A setting of all cells. Repeatable.")
@click.option(
    "--out", type=click.Path(path_type=Path), default=Path("bench-select"), show_default=True, metavar="DIR",
    help="Workspaces, selections, cells, results.json, report.md, views.png and seconds.png go here.",
)  # fmt: skip
@click.option("--smoke", is_flag=True, help="One small scene, two pools, few epochs: shows that it works.")
@click.option("--json", "as_json", is_flag=True, help="Print results.json; messages to stderr.")
@click.option("-q", "--quiet", is_flag=True, help="Warnings and errors only.")
def bench_select(as_json: bool, quiet: bool, out: Path, **options: Any) -> None:
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
    results = run_bench(out=out, console=console, **options)
    console.say(f"{len(results['cells'])} cells: {out / 'report.md'}, {out / 'views.png'}, {out / 'seconds.png'}")
    console.result(results)
