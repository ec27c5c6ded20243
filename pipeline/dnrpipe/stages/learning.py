"""Train the learned selector's weights on the candidates of prepared workspaces."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.console import Console
from ..core.errors import UserError
from ..core.scene_files import split_views
from ..core.workspace import Workspace
from .select import check_budget, look

if TYPE_CHECKING:
    from dnrtrain.selector.protocol import Candidates


def train_weights(
    workspaces: Sequence[Path],
    *,
    out: Path,
    leave_out: Sequence[str],
    budgets: str,
    episodes: int,
    seed: int,
    console: Console,
) -> dict[str, Any]:
    """Write the weights and answer {"out", "scenes", "budgets", "episodes", "seed", "first", "last"}.

    first, last: the surrogate's error that the first and last tenth of the selections left, 1 = with no view.
    Raises UserError: no such workspace, one without passes, a budget above its candidates, nothing left to train on.
    """
    from dnrtrain.selector.dqn import save_network, train
    from dnrtrain.selector.environment import Environment

    wanted = _budgets(budgets)
    if episodes < 1:
        raise UserError(f"--episodes {episodes}: must be at least 1")
    roots = [path for path in workspaces if path.stem not in leave_out]
    if unknown := sorted(set(leave_out) - {path.stem for path in workspaces}):
        raise UserError(f"--leave-out {unknown[0]}: no workspace of that name is given")
    if not roots:
        raise UserError("no workspace is left to train on; name more, or leave out fewer")
    environments = []
    for root in roots:
        candidates = _candidates(root, console)
        for budget in wanted:
            check_budget(budget, len(candidates))
            environments.append(Environment(candidates, budget))
    with console.bar("episodes", episodes) as bar:
        network, history = train(environments, episodes=episodes, seed=seed, tick=bar.advance)
    part = max(1, len(history) // 10)
    made = {
        "scenes": [root.stem for root in roots],
        "budgets": wanted,
        "episodes": episodes,
        "seed": seed,
        "first": sum(history[:part]) / part,
        "last": sum(history[-part:]) / part,
    }
    save_network(out, network, made)
    return {"out": str(out), **made}


def _budgets(text: str) -> list[int]:
    try:
        found = sorted({int(part) for part in text.split(",") if part.strip()})
    except ValueError:
        found = []
    if not found or found[0] < 1:
        raise UserError(f"--budgets {text}: expected numbers of views, e.g. 5,10,25")
    return found


def _candidates(root: Path, console: Console) -> Candidates:
    """The workspace's candidates and what they see."""
    import numpy as np

    from dnrtrain.selector.protocol import Candidates

    workspace = Workspace.open(root)
    if not workspace.cameras("train").is_file():
        raise UserError(f"{root}: not prepared yet; run `dnrpipe prepare -w {root}` first")
    views = split_views(workspace)["train"]
    positions = np.stack([view.position for view in views])
    directions = np.stack([-view.matrix[:3, 2] for view in views])
    return Candidates(positions, directions, look(workspace, console, views))
