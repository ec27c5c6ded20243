"""`dnrpipe ablate`: the variants of the neural renderer side by side."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click


@click.command()
@click.option("--scenes", metavar="A,B", help="Scene files, or names of blender_scenes/ (default: its ten scenes).")
@click.option(
    "--rows",
    metavar="A,B",
    help="Rows or groups: core (default), paper-table, fig7a, fig7b, ingredients, all, vanilla, paper, dnr, ...",
)
@click.option("--seeds", type=int, default=3, show_default=True, metavar="N", help="Every row is trained N times.")
@click.option("--preset", default="draft", show_default=True, metavar="NAME", help="draft, standard or paper.")
@click.option("--budget", type=int, metavar="M", help="Training views (default 25).")
@click.option(
    "--seconds", type=float, metavar="S", help="Train every row for about S seconds, not the preset's epochs."
)
@click.option(
    "--jobs", type=int, default=0, metavar="N", help="Cells side by side (default: one per core; 1 on a GPU)."
)
@click.option("--set", "assignments", multiple=True, metavar="KEY=VALUE", help="A setting of all rows. Repeatable.")
@click.option(
    "--out", type=click.Path(path_type=Path), default=Path("ablation"), show_default=True, metavar="DIR",
    help="Workspaces, cells, results.json, tables.md, plot.png and pictures/ go here.",
)  # fmt: skip
@click.option("--smoke", is_flag=True, help="One small scene, two rows, few epochs: shows that it works.")
@click.option("--json", "as_json", is_flag=True, help="Print results.json; messages to stderr.")
@click.option("-q", "--quiet", is_flag=True, help="Warnings and errors only.")
def ablate(as_json: bool, quiet: bool, out: Path, **options: Any) -> None:
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
    results = run_ablation(out=out, console=console, **options)
    console.say(f"{len(results['cells'])} cells: {out / 'tables.md'}, {out / 'plot.png'}, {out / 'pictures'}")
    console.result(results)
