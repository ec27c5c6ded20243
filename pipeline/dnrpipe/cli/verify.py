"""`dnrpipe verify`: are the files of a workspace whole?"""

from __future__ import annotations

import json
from contextlib import ExitStack

import click


@click.command()
@click.argument("workspace", required=False)
@click.option("-w", "--workspace", "named", metavar="DIR", help="The workspace folder (scene.dnr).")
@click.option("--repair", is_flag=True, help="Throw away what is damaged; the stages named make it again.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
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
    from ..core.console import Console
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
        click.echo(json.dumps({"workspace": str(root), "checked": checked, "faults": rows, "due": due}, indent=2))
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
