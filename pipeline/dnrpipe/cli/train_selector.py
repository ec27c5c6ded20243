"""`dnrpipe train-selector`: weights of the learned selector, from prepared scenes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click


@click.command("train-selector")
@click.argument("workspaces", type=click.Path(path_type=Path), nargs=-1, required=True)
@click.option("--out", type=click.Path(path_type=Path), required=True, metavar="FILE", help="Weights go here.")
@click.option("--leave-out", multiple=True, metavar="NAME", help="Not this scene, for a fair test on it. Repeatable.")
@click.option("--budgets", default="5,10,25", show_default=True, metavar="N,M", help="Numbers of views to learn.")
@click.option("--episodes", type=int, default=600, show_default=True, metavar="N", help="Selections to learn from.")
@click.option("--seed", type=int, default=0, show_default=True, metavar="N")
@click.option("--json", "as_json", is_flag=True, help="Print what was trained as JSON; messages to stderr.")
@click.option("-q", "--quiet", is_flag=True, help="Warnings and errors only.")
def train_selector(as_json: bool, quiet: bool, **options: Any) -> None:
    """Train the selector `dqn` on prepared workspaces (`dnrpipe prepare`); nothing is ray-traced.

    It learns which views lower the error of a cheap stand-in for texture training on all rasterised candidates.
    The same workspaces, options and seed give the same weights. Use them with `--set select.weights=FILE`.

    \b
    Examples:
      dnrpipe train-selector bricks.dnr ship.dnr --out selector.safetensors
      dnrpipe train-selector scenes/*.dnr --leave-out interior --out without-interior.safetensors
      dnrpipe select --policy dqn --set select.weights=without-interior.safetensors -w interior.dnr
    """
    from ..core.console import Console
    from ..stages.learning import train_weights

    console = Console(json_mode=as_json, quiet=quiet)
    made = train_weights(console=console, **options)
    console.say(
        f"{made['out']}: {made['episodes']} episodes on {len(made['scenes'])} scenes; error left on average:"
        f" {made['first']:.1%} at first, {made['last']:.1%} at last"
    )
    console.result(made)
