"""Health, metrics, and the dashboard's files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fastapi import APIRouter, HTTPException
from fastapi.responses import FileResponse, PlainTextResponse

from .. import __version__
from .models import Health
from .routes_jobs import REFUSED, refusals
from .state import Shared
from .worker import folder_mb

STATIC = Path(__file__).parent / "static"
REPORT = Path(__file__).parents[1] / "report"
TYPES = {".js": "text/javascript", ".css": "text/css", ".html": "text/html"}
PAGES = {
    **{name: STATIC / name for name in ("api.js", "app.js", "plots.js", "viewer.js", "style.css", "viewer.html")},
    **{name: REPORT / name for name in ("sphere.js", "report.css")},
}
TEXT: dict[int | str, dict[str, Any]] = {200: {"content": {"text/plain": {}}, "description": "Prometheus text format"}}

router = APIRouter(tags=["server"], responses=REFUSED)


@router.get("/healthz")
def healthz(service: Shared) -> Health:
    """Whether the server's workers live. Needs no token."""
    workers, counts = service.supervisor.alive(), service.queue.counts()
    return Health(
        status="ok" if all(workers.values()) else "degraded",
        version=__version__,
        workers=workers,
        queued=counts["queued"],
        running=counts["running"],
    )


@router.get("/metrics", response_class=PlainTextResponse, responses=TEXT)
def metrics(service: Shared) -> PlainTextResponse:
    """Gauges for Prometheus."""
    lines = []

    def gauge(name: str, text: str, values: dict[str, float]) -> None:
        lines.append(f"# HELP dnrpipe_{name} {text}")
        lines.append(f"# TYPE dnrpipe_{name} gauge")
        lines.extend(f"dnrpipe_{name}{labels} {value}" for labels, value in values.items())

    counts = service.queue.counts()
    gauge("jobs", "Jobs by state.", {f'{{state="{state}"}}': n for state, n in counts.items()})
    alive = service.supervisor.alive()
    gauge("worker_up", "1 where the device's worker lives.", {f'{{device="{d}"}}': int(u) for d, u in alive.items()})
    gauge("streams", "Open event streams and viewers.", {"": service.streams})
    gauge("viewers", "Workspaces viewed live.", {"": len(service.live.sessions)})
    gauge("scenes_megabytes", "Size of the uploaded scenes, MiB.", {"": round(folder_mb(service.root.scenes), 3)})
    return PlainTextResponse("\n".join(lines) + "\n", media_type="text/plain; version=0.0.4")


@router.get("/", include_in_schema=False)
def dashboard() -> FileResponse:
    return FileResponse(STATIC / "index.html", media_type="text/html")


@router.get("/favicon.ico", include_in_schema=False)
def icon() -> FileResponse:
    return FileResponse(STATIC / "icon.svg", media_type="image/svg+xml")


@router.get("/static/{file}", include_in_schema=False, responses=refusals(404))
def static(file: str) -> FileResponse:
    """One of the named files; there is no listing."""
    if file not in PAGES:
        raise HTTPException(404, "no such page")
    return FileResponse(PAGES[file], media_type=TYPES[PAGES[file].suffix])
