"""A fleet's summary as text and as a page that needs nothing else."""

from __future__ import annotations

from html import escape

from ..core.units import duration
from .records import FleetRow, FleetSummary

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 60rem; padding: 0 1rem; color: #1b1b1b;
       background: #fff }
table { border-collapse: collapse; width: 100% }
th, td { text-align: left; padding: .4rem .8rem; border-bottom: 1px solid #ccc; vertical-align: top }
td.number { text-align: right; font-variant-numeric: tabular-nums }
.failed { color: #9c1c1c }
@media (prefers-color-scheme: dark) {
  body { color: #e8e8e8; background: #161616 } th, td { border-color: #444 } a { color: #8ab8ff }
  .failed { color: #ff9a9a }
}
"""
HEADS = ("scene", "state", "PSNR", "time", "report")


def page(summary: FleetSummary, jobs: int) -> str:
    """HTML, without scripts. jobs: of the whole fleet; those that have not ended are counted."""
    rows = "\n".join(_row(row) for row in summary.rows)
    heads = "".join(f'<th scope="col">{name}</th>' for name in HEADS)
    return f"""<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'unsafe-inline'">
<title>Fleet</title>
<style>{STYLE}</style>
<h1>Fleet</h1>
<p>{told(summary, jobs)}</p>
<table>
<thead><tr>{heads}</tr></thead>
<tbody>
{rows}
</tbody>
</table>
</html>
"""


def told(summary: FleetSummary, jobs: int) -> str:
    """One line."""
    failed, waiting = len(summary.failed), jobs - len(summary.rows)
    parts = [f"{len(summary.rows) - failed} of {jobs} done", *([f"{failed} failed"] if failed else [])]
    return ", ".join([*parts, *([f"{waiting} not ended yet"] if waiting else [])])


def table(summary: FleetSummary) -> str:
    """For the terminal."""
    width = max(len(row.name) for row in summary.rows)
    lines = []
    for row in summary.rows:
        psnr = f"{row.psnr:.2f} dB" if row.psnr is not None else "-"
        end = row.report or "-" if row.state == "done" else f"{row.failed_at}: {row.error}"
        lines.append(f"{row.name:<{width}}  {row.state:<11}  {psnr:>9}  {duration(row.seconds):>12}  {end}")
    return "\n".join(lines)


def _row(row: FleetRow) -> str:
    psnr = f"{row.psnr:.2f} dB" if row.psnr is not None else "–"
    links = [f'<a href="{escape(row.report)}">report</a>'] if row.report else []
    links.append(f'<a href="{escape(row.log)}">log</a>')
    why = "" if row.state == "done" else f"<br>{escape(row.failed_at)}: {escape(row.error)}"
    kind = "" if row.state == "done" else ' class="failed"'
    return (
        f'<tr><th scope="row">{escape(row.name)}</th><td{kind}>{row.state}{why}</td><td class="number">{psnr}</td>'
        f'<td class="number">{duration(row.seconds)}</td><td>{" · ".join(links)}</td></tr>'
    )
