"""The report: one self-contained HTML file with the result, its quality and its cost.

    workspace files -> collect.py -> ReportData -> render.py -> report/report.html (+ report.json)

The same workspace gives the same bytes, but for the date of making.
"""

from __future__ import annotations

from datetime import datetime
from pathlib import Path


def build_report(workspace_dir: Path, *, made_at: datetime | None = None) -> Path:
    """Write `report/report.html` and `report/report.json` (the same figures, for machines).

    It shows the stages that have run, and names the commands for the rest. Returns the path of the HTML file.
    made_at: the date shown, now (UTC) when None. Raises UserError: not a workspace, or one of its files is damaged.
    """
    from dnrtrain.atomic import write_json, write_text

    from .collect import collect
    from .render import render_html

    data = collect(Path(workspace_dir), made_at=made_at)
    path = Path(workspace_dir) / "report" / "report.html"
    write_text(path, render_html(data))
    write_json(path.with_suffix(".json"), data.model_dump(mode="json"))
    return path
