"""What a fleet's summary holds."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ValidationError

from ..core.errors import UserError


class FleetRow(BaseModel, frozen=True):
    """How one job ended.

    Args:
        failed_at: the command that failed, "" where none did.
        seconds: wall seconds of this run of it.
        psnr: mean over the held-out views, dB; None where nothing was evaluated.
        report: relative to the summary.
    """

    name: str
    scene: str
    state: Literal["done", "failed", "interrupted"]
    failed_at: str = ""
    error: str = ""
    seconds: float
    psnr: float | None = None
    report: str | None = None
    log: str


class FleetSummary(BaseModel, frozen=True):
    """``fleet.json``. rows: in the order of the file."""

    finished: float
    rows: list[FleetRow]

    @property
    def failed(self) -> list[FleetRow]:
        return [row for row in self.rows if row.state != "done"]


def read_rows(out: Path) -> list[FleetRow]:
    """Rows of the summary in a fleet's folder; [] where there is none. Raises UserError: it is damaged."""
    path = out / "fleet.json"
    try:
        return FleetSummary.model_validate_json(path.read_bytes()).rows
    except FileNotFoundError:
        return []
    except ValidationError:
        raise UserError(f"{path}: is damaged; run the fleet again") from None
