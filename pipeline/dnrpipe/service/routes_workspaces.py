"""Workspaces: state, pictures, report. Scene files: upload, list, remove."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from fastapi import APIRouter, HTTPException, Path, Request, Response
from fastapi.responses import FileResponse
from starlette.background import BackgroundTask
from starlette.concurrency import run_in_threadpool

from dnrtrain.contract import DamagedFile
from dnrtrain.records import read

from ..core.errors import UserError
from ..core.ledger import total
from ..core.settings import Settings
from ..core.workspace import Workspace
from ..report.charts import AZIMUTH, ELEVATION, sphere_svg
from ..report.collect import outline
from ..stages.pipeline import status
from ..stages.records import PREVIEW, PreviewState
from ..stages.session import resolve_settings
from ..studies.planning.records import RENDERER_STAGES, Choice, read_plan
from .models import (
    NAME_PATTERN,
    SCENE_PATTERN,
    CostState,
    Curve,
    Deleted,
    PlannedStage,
    PlanState,
    Result,
    Scene,
    StageState,
    TestPicture,
    WorkspaceDetail,
    WorkspaceSummary,
)
from .results import pack, packed_mb, results
from .root import UnknownName
from .routes_jobs import REFUSED, refusals
from .state import Shared, State
from .uploads import receive
from .users import Caller, User
from .worker import folder_mb

NamePath = Annotated[str, Path(pattern=NAME_PATTERN)]
ScenePath = Annotated[str, Path(pattern=SCENE_PATTERN)]
DeletedPath = Annotated[str, Path(pattern=r"^[0-9]{1,20}-[A-Za-z0-9][A-Za-z0-9_-]{0,63}$")]
ViewPath = Annotated[str, Path(pattern=r"^[A-Za-z0-9_-][A-Za-z0-9_.-]{0,99}$")]
# The page holds names from scene files: it may run its own scripts, but load and send nothing.
REPORT_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:; base-uri 'none';"
    " form-action 'none'; frame-ancestors 'none'; sandbox allow-scripts"
)
ANY: dict[int | str, dict[str, Any]] = {200: {"content": {"application/octet-stream": {}}, "description": "A file"}}
PNG: dict[int | str, dict[str, Any]] = {200: {"content": {"image/png": {}}, "description": "PNG"}}
HTML: dict[int | str, dict[str, Any]] = {200: {"content": {"text/html": {}}, "description": "One HTML file"}}

router = APIRouter(tags=["workspaces"], responses=REFUSED)


@router.get("/workspaces")
def list_workspaces(service: Shared) -> list[WorkspaceSummary]:
    """All workspaces of the server, by name."""
    found, owners = [], service.queue.owners()
    for name in service.root.workspaces():
        path = service.root.workspace(name)
        problem = None
        try:
            workspace = Workspace.open(path)
        except UserError as error:
            workspace, problem = None, str(error)
        found.append(
            WorkspaceSummary(
                name=name,
                modified=(path / "manifest.json").stat().st_mtime,
                viewable=workspace is not None and "finetune" in workspace.manifest.stages,
                report=(path / "report" / "report.html").is_file(),
                owner=owners.get(name),
                mb=service.sizes.get(name, 0, lambda path=path: round(folder_mb(path), 1)),
                problem=problem,
            )
        )
    return found


@router.get("/workspaces/{name}", responses=refusals(404, 409))
def get_workspace(name: NamePath, service: Shared) -> WorkspaceDetail:
    """Stages, cameras, training, held-out views and costs, at most a second old. 409: a file of it is damaged."""
    service.root.workspace(name)
    return service.details.get(name, service.queue.last_event(), lambda: _detail(name, service))


def _detail(name: str, service: State) -> WorkspaceDetail:
    path = service.root.workspace(name)
    try:
        workspace = Workspace.open(path)
        settings = resolve_settings(workspace, {}, None)
        rows = status(workspace, settings)
        plan = plan_state(workspace, settings, {row.stage: row.state for row in rows})
        known = outline(path)
    except UserError as error:
        raise HTTPException(409, str(error)) from None
    tracing = known.costs.tracing_all
    sphere = known.sphere
    return WorkspaceDetail(
        name=name,
        stages=[StageState(**{key: getattr(row, key) for key in StageState.model_fields}) for row in rows],
        views=sphere.views if sphere else [],
        sphere=str(sphere_svg(sphere, "oblique")) if sphere else None,
        eye=(AZIMUTH, ELEVATION),
        training=[Curve(title=t.title, losses=t.losses, psnr=t.psnr) for t in known.training],
        tests=[TestPicture(view=v.name, psnr=v.psnr) for v in (known.metrics.views if known.metrics else ())],
        costs=CostState(
            spent={stage: part.wall_seconds for stage, part in known.costs.by_stage.items()},
            total=known.costs.total.wall_seconds,
            traced_views=tracing.views if tracing else None,
            candidates=tracing.candidates if tracing else None,
            tracing_seconds=tracing.actual_seconds if tracing else None,
            tracing_all_seconds=tracing.all_seconds if tracing else None,
        ),
        plan=plan,
        viewable="finetune" in workspace.manifest.stages,
        report=(path / "report" / "report.html").is_file(),
    )


@router.delete("/workspaces/{name}", responses=refusals(404, 409))
def delete_workspace(name: NamePath, service: Shared, caller: Caller) -> Deleted:
    """Delete a workspace; for some days it can be restored. 409: a job waits for it or works in it."""
    service.root.workspace(name)
    require_owner(service.queue.owners().get(name), caller, name)
    if service.queue.busy(name):
        raise HTTPException(409, f"{name}: a job waits for it or works in it; cancel that first")
    put_away = service.root.delete(name)
    return next(entry for entry in _restorable(service) if entry.id == put_away)


@router.get("/deleted")
def list_deleted(service: Shared) -> list[Deleted]:
    """Workspaces that can be restored, the last deleted first."""
    return _restorable(service)


@router.post("/deleted/{id}/restore", responses=refusals(404, 409))
def restore_workspace(id: DeletedPath, service: Shared, caller: Caller) -> Deleted:
    """Put a deleted workspace back. 409: there is another of its name by now."""
    found = next((entry for entry in _restorable(service) if entry.id == id), None)
    if found is not None:
        require_owner(found.owner, caller, found.name)
    try:
        service.root.restore(id)
    except UnknownName:
        raise
    except UserError as error:
        raise HTTPException(409, str(error)) from None
    assert found is not None
    return found


def _restorable(service: State) -> list[Deleted]:
    owners, kept = service.queue.owners(), 86_400 * service.config.undo_days
    return [
        Deleted(id=put_away, name=name, until=when + kept, owner=owners.get(name))
        for put_away, name, when in service.root.restorable()
    ]


def require_owner(owner: str | None, caller: User, name: str) -> None:
    """Raises HTTPException 403: another's workspace, and not an admin."""
    if not caller.may_change(owner):
        raise HTTPException(403, f"{name} is {owner or 'nobody'}'s; only they and admins may delete or restore it")


@router.get("/workspaces/{name}/results", responses=refusals(404))
def list_results(name: NamePath, service: Shared) -> list[Result]:
    """What there is to download: movies, frames, exports, the report."""
    return results(service.root.workspace(name))


@router.get("/workspaces/{name}/results/{file:path}", response_class=FileResponse, responses=refusals(404, 507) | ANY)
async def download(name: NamePath, file: Annotated[str, Path(max_length=200)], service: Shared) -> FileResponse:
    """One of the results; folders come as a zip, and are packed one at a time."""
    found = await run_in_threadpool(_file_of, name, file, service)
    if found is None:
        async with service.packing:  # who waits here holds no thread that others need
            return await run_in_threadpool(_folder_of, name, file, service)
    return found


def _file_of(name: str, file: str, service: State) -> FileResponse | None:
    """A result that is a file; None: it is a folder, or gone. Raises HTTPException 404."""
    workspace = service.root.workspace(name)
    if file not in (found.file for found in results(workspace)):
        raise HTTPException(404, f"{name} has no result {file[:80]!r}; see GET /workspaces/{name}/results")
    if not (workspace / file).is_file():
        return None
    path = service.root.result(name, file, f"{name} has no result {file[:80]!r}")
    return FileResponse(path, media_type="application/octet-stream", filename=_saved_as(name, file))


def _folder_of(name: str, file: str, service: State) -> FileResponse:
    """A result that is a folder, as a zip. Raises HTTPException 507."""
    folder = service.root.workspace(name) / file.removesuffix(".zip")
    service.require_space(service.root.private, packed_mb(folder))
    packed = service.root.private / f"{secrets.token_hex(8)}.zip"
    try:
        pack(folder, packed)
    except BaseException:
        packed.unlink(missing_ok=True)
        raise
    gone = BackgroundTask(packed.unlink, missing_ok=True)
    return FileResponse(packed, media_type="application/zip", filename=_saved_as(name, file), background=gone)


def _saved_as(name: str, file: str) -> str:
    return f"{name}-{file.rpartition('/')[2]}"


@router.get("/workspaces/{name}/preview", responses=refusals(404, 409))
def preview(name: NamePath, service: Shared) -> PreviewState:
    """What the last picture of fine-tuning shows. 409: its file is damaged."""
    path = service.root.result(name, f"preview/{PREVIEW}", f"{name} has no picture of a training")
    try:
        return read(path, PreviewState)
    except FileNotFoundError:
        raise HTTPException(404, f"{name} has no picture of a training") from None
    except DamagedFile:
        raise HTTPException(409, f"{name}: preview.json is damaged; the next training replaces it") from None


@router.get("/workspaces/{name}/preview/{kind}", response_class=FileResponse, responses=refusals(404) | PNG)
def preview_picture(name: NamePath, kind: Literal["truth", "prediction"], service: Shared) -> FileResponse:
    """The view as fine-tuning last rendered it, or its ray-traced reference."""
    path = service.root.result(name, f"preview/{kind}.png", f"{name} has no picture {kind} of a training")
    return FileResponse(path, media_type="image/png")


@router.get("/workspaces/{name}/pictures/{view}/{kind}", response_class=FileResponse, responses=refusals(404) | PNG)
def picture(
    name: NamePath, view: ViewPath, kind: Literal["truth", "prediction", "flip"], service: Shared
) -> FileResponse:
    """A held-out view of the evaluation: ray-traced, by the neural renderer, or the FLIP error map."""
    path = service.root.result(name, f"evaluation/{view}.{kind}.png", f"{name} has no picture {kind} of view {view}")
    return FileResponse(path, media_type="image/png")


@router.get("/workspaces/{name}/report", response_class=FileResponse, responses=refusals(404) | HTML)
def report(name: NamePath, service: Shared) -> FileResponse:
    """The report of the last `run` or `report`."""
    path = service.root.result(name, "report/report.html", f"{name} has no report yet; submit a job report")
    return FileResponse(path, media_type="text/html", headers={"content-security-policy": REPORT_POLICY})


@router.get("/scenes")
def list_scenes(service: Shared) -> list[Scene]:
    """Uploaded scene files, by name."""
    found = sorted(p for p in service.root.scenes.iterdir() if p.is_file() and not p.name.startswith("."))
    return [Scene(name=path.name, size=path.stat().st_size) for path in found]


@router.put(
    "/scenes/{name}",
    status_code=201,
    responses=refusals(409, 507),
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}},
        }
    },
)
async def upload(name: ScenePath, request: Request, service: Shared) -> Scene:
    """Store a scene file; the body is the file. It appears whole or not at all, and replaces one of the same name.

    Jobs that were submitted with a former file of that name keep theirs; `replaced` says that it was another. Textures
    must be packed into it. Scripts embedded in it are never run.
    """
    target = service.root.scene(name, must_exist=False)
    await run_in_threadpool(_check_space, service, name)
    temporary = target.parent / f".{secrets.token_hex(8)}.part"
    try:
        sha256, size = await receive(request, temporary, service.config.upload_mb)
        if size == 0:
            raise HTTPException(422, "the body is empty; it must be the scene file")
        replaced = await run_in_threadpool(service.root.keep_scene, temporary, name, sha256)
    finally:
        temporary.unlink(missing_ok=True)
    return Scene(name=name, size=size, sha256=sha256, replaced=replaced)


@router.delete("/scenes/{name}", status_code=204, responses=refusals(404))
def remove(name: ScenePath, service: Shared) -> Response:
    """Remove a scene file. Workspaces made from it stay as they are, and so do jobs submitted with it."""
    service.root.scene(name).unlink(missing_ok=True)
    return Response(status_code=204)


def _check_space(service: State, name: str) -> None:
    """Raises HTTPException 409 or 507."""
    stored = {path.name for path in service.root.scenes.iterdir()}
    if name not in stored and len(stored) >= service.config.most_scenes:
        raise HTTPException(409, f"there are {service.config.most_scenes} scenes already; remove some")
    service.require_space(service.root.scenes)


def plan_state(workspace: Workspace, settings: Settings, states: Mapping[str, str]) -> PlanState | None:
    """The last plan's prediction and the seconds spent since; None without a plan. states: of the stages, by name.

    The prediction for ``settings`` comes first. A finished stage counts the wall seconds of its last run, or, if that
    was interrupted, the ledger's records of its parts. A running stage counts the records so far, which leave out the
    start of processes. Raises UserError: the plan's file is damaged.
    """
    plan = read_plan(workspace.root)
    if plan is None:
        return None
    known = [found for found in (plan.carried_out, plan.chosen, plan.settings_default) if found is not None]
    prediction = next((found for found in known if _fits(found.choice, settings)), known[0])
    seconds, choice = prediction.seconds, prediction.choice
    since = [record for record in workspace.ledger.read() if record.time >= plan.made]
    stages = []
    for stage in (*RENDERER_STAGES, "evaluate"):
        record = workspace.manifest.stages.get(stage)
        done = states.get(stage) == "done"
        spent: float | None = total(r for r in since if r.stage == stage).wall_seconds
        if record is not None and record.finished >= plan.made:
            spent = max(spent, record.seconds)
        elif done and not spent:
            spent = None
        stages.append(PlannedStage(stage=stage, predicted=getattr(seconds, stage), spent=spent, done=done))
    return PlanState(
        made=plan.made,
        **choice.model_dump(include={"views", "spp", "epochs"}),
        fits=_fits(choice, settings),
        stages=stages,
        total=seconds.total.expected,
        low=seconds.total.low,
        high=seconds.total.high,
        spent=sum(stage.spent or 0.0 for stage in stages if stage.stage in RENDERER_STAGES),
    )


def _fits(choice: Choice, settings: Settings) -> bool:
    wanted: tuple[Any, ...] = (settings.select.budget, settings.raytrace.spp, settings.finetune.step2.epochs)
    targets = settings.raytrace.noise is not None or settings.raytrace.time is not None
    return not targets and wanted == (choice.views, choice.spp, choice.epochs)
