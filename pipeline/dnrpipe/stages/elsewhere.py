"""A whole stage on one node of a cluster: where it trains, a network is on one device, and this machine may have none.

Lists of tasks are spread by `Run.place`; training is one task, which reads and writes the workspace as the stage does.
"""

from __future__ import annotations

import threading

from ..core.ledger import StageName
from ..core.settings import Settings
from ..workers.view_tasks import only_answer
from .stage import Outcome, Run


def trains(name: StageName, settings: Settings) -> bool:
    """Whether a stage trains a network, or tries to."""
    if name == "select":
        return settings.trains_step1 or settings.select.budget == "auto"
    return name == "finetune" and settings.select.budget != 0


def make_elsewhere(run: Run) -> Outcome:
    """The stage's outcome; a GPU is asked for where the cluster has any and the settings do not say cpu.

    Raises UserError: it failed twice, or was refused.
    """
    ledger = run.workspace.ledger
    booked = len(ledger.read())
    with run.console.bar(f"{run.stage} on the cluster", 1) as bar:
        answer = only_answer(
            run.stage,
            "dnrpipe.stages.stage_worker",
            {"device": run.settings.device},
            {
                "workspace": str(run.workspace.root),
                "settings": run.settings.model_dump(mode="json"),
                "stage": run.stage,
                "id": run.id,
                "fingerprint": run.fingerprint,
            },
            log=run.log,
            console=run.console,
            place=run.place,
            timeout=threading.TIMEOUT_MAX,  # as here, training has none
        )
        bar.advance()
    ledger.booked += sum(record.wall_seconds for record in ledger.read()[booked:])  # there, into the same file
    return Outcome(answer["output"], answer["detail"])
