"""Commands of the service: serve; submit, jobs, logs, cancel, retry, which talk to a server. `worker` is beside it."""

from __future__ import annotations

import ipaddress
import json
import os
import re
import time
from collections.abc import Callable
from contextlib import ExitStack
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import click

from ..core.console import Bar, Console
from ..core.errors import UserError
from .options import EXECUTOR_OPTIONS, executor_assignments, print_json
from .options import options as with_options

if TYPE_CHECKING:
    from ..service.client import Client
    from ..service.models import Job

SERVER = [
    click.option("--server", metavar="URL", help="Default: DNRPIPE_SERVER, else http://127.0.0.1:8420."),
    click.option(
        "--token-file", type=click.Path(path_type=Path), metavar="FILE", help="Default: DNRPIPE_TOKEN_FILE, if any."
    ),
    click.option("--json", "as_json", is_flag=True, help="Print one JSON value; messages to stderr."),
]
COMMANDS = [
    *("run", "prepare", "select", "raytrace-selected", "finetune", "evaluate", "render", "report", "shot"),
    *("export-nerf", "export-onnx", "export-gltf", "export-web"),
]
MOST = 1_000_000
"""Of what has no limit of its own."""
STATES = ["queued", "running", "done", "failed", "cancelled"]


def server_and_token(server: str | None, token_file: Path | None) -> tuple[str, str | None]:
    """What the options, else the environment, name. Raises UserError: no token in the file."""
    from ..service.client import DEFAULT_SERVER
    from ..service.users import read_token

    named = token_file or os.environ.get("DNRPIPE_TOKEN_FILE")
    return server or os.environ.get("DNRPIPE_SERVER") or DEFAULT_SERVER, read_token(Path(named)) if named else None


def _client(server: str | None, token_file: Path | None) -> Client:
    from ..service.client import Client

    return Client(*server_and_token(server, token_file))


@click.command()
@click.option("--host", default="127.0.0.1", show_default=True, help="Another host than loopback needs --token-file.")
@click.option("--port", type=click.IntRange(0, 65535), default=8420, show_default=True, help="0 = any free one.")
@click.option(
    "--root", type=click.Path(path_type=Path), default=Path(), metavar="DIR",
    help="Workspaces, scenes and the queue live here (default: this folder).",
)  # fmt: skip
@click.option(
    "--token-file",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Who may do what (docs/service.md).",
)
@click.option("--devices", metavar="A,B", help="A worker each: cpu, cuda:0, ...; or none (default: GPUs, else cpu).")
@click.option("--upload-mb", type=click.IntRange(1), metavar="N", help="Largest scene file (default 2048 MiB).")
@click.option("--most-queued", type=click.IntRange(1), metavar="N", help="Jobs that may wait (default 10000).")
@click.option("--rate", type=float, metavar="N", help="Requests per second and client address (default 50).")
@click.option("--job-hours", type=float, metavar="H", help="Longest job (default 24).")
@click.option("--job-memory-mb", type=click.IntRange(64), metavar="N", help="Of a job's processes (default 80%).")
@click.option("--job-disk-mb", type=click.IntRange(1), metavar="N", help="Of a job's workspace (default 51200).")
@click.option("--keep-days", type=float, metavar="D", help="Logs and events of ended jobs (default 30 days).")
@click.option("--keep-jobs", type=click.IntRange(1), metavar="N", help="Those of the last N ended jobs (default 1000).")
@click.option("--trusted-proxy", metavar="IP", help="Believe what this proxy says of its clients (default: none).")
@click.option("--public-url", metavar="URL", help="Address that browsers know the server by, behind a proxy.")
@click.option("--webhook", "webhooks", metavar="URL", multiple=True, help="Jobs may tell addresses that begin so.")
@with_options(EXECUTOR_OPTIONS)
def serve(
    host: str,
    port: int,
    root: Path,
    token_file: Path | None,
    devices: str | None,
    job_hours: float | None,
    job_memory_mb: int | None,
    job_disk_mb: int | None,
    **options: Any,
) -> None:
    """Serve the pipeline: a job queue, a dashboard and a live viewer in the browser.

    Jobs survive kill -9 and power cuts: they go on from their checkpoints when the server is started again.
    Listens on this machine only, unless --host says otherwise; then every request must carry the token.

    \b
    Examples:
      dnrpipe serve --root ~/scenes          # then open http://127.0.0.1:8420
      dnrpipe serve --host 0.0.0.0 --token-file token.txt
      dnrpipe submit scene.blend             # in another terminal
    """
    from ..service.config import ServerConfig, default_memory_mb
    from ..service.models import Limits
    from ..service.server import serve as run_server
    from ..service.users import read_users

    users = read_users(token_file) if token_file is not None else None
    chosen = () if devices == "none" else chosen_devices(devices)
    days = options["keep_days"]
    if days is not None and not 0 < days <= 36_500:
        raise UserError(f"--keep-days {days:g}: must be above 0, and 36500 at most")
    for name, value in (("--job-hours", job_hours), ("--rate", options["rate"])):
        if value is not None and not 0 < value <= MOST:  # nan is neither
            raise UserError(f"{name} {value:g}: must be above 0, and {MOST} at most")
    limits = Limits(
        seconds=3600 * min(job_hours or 24.0, 720.0),
        memory_mb=job_memory_mb or default_memory_mb(),
        disk_mb=job_disk_mb or 50 * 1024,
    )
    url, proxy = options["public_url"], options["trusted_proxy"]
    if url is not None and not _is_address(url):
        raise UserError(f"--public-url {url}: expected an address such as https://render.example.org")
    if proxy is not None:
        try:
            ipaddress.ip_address(proxy)
        except ValueError:
            raise UserError(f"--trusted-proxy {proxy}: expected the proxy's IP address") from None
    for hook in options["webhooks"]:
        if not _is_address(hook, path=True):
            raise UserError(f"--webhook {hook}: expected an address such as https://ci.example.org/hooks/")
    if options["executor"] == "ray" and (options["address"] or "local") == "local":
        raise UserError("--executor ray: name the cluster that all jobs share: --address auto, or HOST:PORT")
    executor = tuple(executor_assignments(options))
    given = {key: value for key, value in options.items() if value is not None}
    if "rate" in given:
        given["burst"] = max(1, int(4 * given["rate"]))
    config = ServerConfig(root=root, host=host, port=port, devices=chosen, limits=limits, executor=executor, **given)
    console = Console()
    whole = root.resolve()  # the server works in it

    def ready(address: str) -> None:
        workers = ", ".join(chosen) or "none of its own"
        console.say(f"serving {whole}, workers: {workers}; Ctrl-C stops, jobs go on at the next start")
        console.say(f"dashboard: {address}")
        if url is not None:
            console.say(f"for browsers: {url}")

    run_server(config, users, ready=ready)


def chosen_devices(text: str | None) -> tuple[str, ...]:
    """The devices that ``--devices`` names; None: all there are. Raises UserError."""
    from ..service.config import default_devices

    chosen = tuple(part.strip() for part in text.split(",")) if text else default_devices()
    for name in chosen:
        if name != "cpu" and not (name.startswith("cuda:") and name.removeprefix("cuda:").isdigit()):
            raise UserError(f"--devices {name}: neither cpu nor cuda:<number>")
    if len(set(chosen)) < len(chosen):
        raise UserError(f"--devices {text}: names a device twice")
    return chosen


def _is_address(url: str, *, path: bool = False) -> bool:
    """Scheme, host and perhaps a port; and a path, where there may be one."""
    try:
        parts = urlsplit(url)
        whole = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
        return whole and (path or parts.path in ("", "/"))
    except ValueError:
        return False


@click.command()
@click.argument("scene")
@click.option("--stage", "command", type=click.Choice(COMMANDS), default="run", show_default=True)
@click.option("-w", "--workspace", metavar="NAME", help="Name on the server (default: the scene's).")
@click.option("--preset", metavar="NAME", help="draft (default), standard, paper, vanilla, paper-128 or vanilla-128.")
@click.option("--set", "assignments", multiple=True, metavar="KEY=VALUE", help="Any setting, e.g. select.budget=10.")
@click.option("--force", is_flag=True, help="Do it again, reusing nothing.")
@click.option("--priority", type=click.IntRange(-100, 100), default=0, show_default=True, help="Larger goes first.")
@click.option("--hours", type=float, metavar="H", help="Stop the job after this time.")
@click.option("--memory-mb", type=click.IntRange(64), metavar="N", help="Stop it above this memory.")
@click.option("--disk-mb", type=click.IntRange(1), metavar="N", help="Stop it when its workspace is larger.")
@click.option("--orbit", type=click.IntRange(1, 10_000), metavar="N", help="Frames of `--stage render` (default 60).")
@click.option("--frames", metavar="RANGE", help="Of `--stage shot`, such as 1-240.")
@click.option("--size", metavar="WxH", help="Of `--stage shot`, such as 1280x720.")
@click.option("--webhook", metavar="URL", help="Told when the job has ended; the server's operator allows which.")
@click.option("--detach", is_flag=True, help="Do not wait for the job.")
@with_options(SERVER)
def submit(
    scene: str,
    command: str,
    workspace: str | None,
    preset: str | None,
    assignments: tuple[str, ...],
    force: bool,
    priority: int,
    hours: float | None,
    memory_mb: int | None,
    disk_mb: int | None,
    orbit: int | None,
    frames: str | None,
    size: str | None,
    webhook: str | None,
    detach: bool,
    as_json: bool,
    **server: Any,
) -> None:
    """Send a job to a server, and show its progress.

    SCENE is a scene file, which is uploaded (textures must be packed into it), or a workspace's name on the server.
    Ctrl-C stops watching; the job goes on.

    \b
    Examples:
      dnrpipe submit scene.blend --set select.budget=25
      dnrpipe submit scene --stage evaluate --force
      dnrpipe submit scene --stage render --orbit 120
      dnrpipe submit scene.blend --stage shot --frames 1-48 --size 640x360
      dnrpipe submit scene.blend --server http://box:8420 --token-file token.txt --detach
    """
    import pydantic

    from ..service.models import JobRequest, Limits, first_fault

    console = Console(json_mode=as_json)
    path = Path(scene)
    is_file = path.is_file()
    if not is_file and (path.suffix or "/" in scene):
        raise UserError(f"{scene}: no such file; give a scene file or a workspace's name")
    settings = {}
    for text in assignments:
        key, equals, value = text.partition("=")
        if not equals:
            raise UserError(f"--set {text!r}: expected KEY=VALUE, e.g. --set finetune.step2.epochs=20")
        settings[key.strip()] = value.strip()
    name = workspace or _plain(path.stem if is_file else scene)
    upload = f"{_plain(path.stem)}{path.suffix.lower()}" if is_file else None
    fields = {"command": command, "workspace": name, "scene": upload, "preset": preset, "settings": settings}
    fields |= {"orbit": orbit, "frames": frames, "size": size, "webhook": webhook}
    try:
        limits = Limits(seconds=3600 * hours if hours is not None else None, memory_mb=memory_mb, disk_mb=disk_mb)
        request = JobRequest(**fields, force=force, priority=priority, limits=limits)  # type: ignore[arg-type]
    except pydantic.ValidationError as error:
        raise UserError(f"submit: {first_fault(error)}") from None
    with _client(**server) as client:
        if upload is not None:
            with console.bar(f"uploading {path.name}", path.stat().st_size) as bar:
                stored = client.upload(path, upload, sent=bar.advance)
            request = request.model_copy(update={"scene_sha256": stored.sha256})
            if stored.replaced:
                console.warn(f"{upload}: another file of that name was there; jobs submitted with it keep it")
        job = client.submit(request)
        console.say(f"job {job.id}: {command} of {name}")
        if not detach:
            job = _follow(client, job, console)
    console.result(job.model_dump(mode="json"))
    if job.state == "failed":
        raise UserError(f"job {job.id}: {job.error}")
    if job.state == "cancelled":
        raise UserError(f"job {job.id} was cancelled; `dnrpipe retry {job.id}` goes on")


@click.command()
@click.option("--state", "states", type=click.Choice(STATES), multiple=True, help="Only these. Repeatable.")
@click.option("--search", default="", metavar="WORDS", help="In number, workspace, command or owner.")
@click.option("-n", "--limit", type=click.IntRange(1), default=20, show_default=True, metavar="N")
@with_options(SERVER)
def jobs(states: tuple[str, ...], search: str, limit: int, as_json: bool, **server: Any) -> None:
    """List the jobs of a server, newest first.

    \b
    Examples:
      dnrpipe jobs
      dnrpipe jobs --state queued --state running --json
    """
    with _client(**server) as client:
        found = list(islice(client.jobs(states, search), limit))  # type: ignore[arg-type]
    if as_json:
        print_json([job.model_dump(mode="json") for job in found])
        return
    for job in found:
        what = f"{job.id:>6}  {job.state:9}  {job.request.command:17}  {job.request.workspace:20}"
        click.echo(f"{what}  {job.owner or '':10}  {_how(job)}")
    if not found:
        click.echo("no jobs")


@click.command()
@click.argument("job", type=click.IntRange(1))
@click.option("-f", "--follow", is_flag=True, help="Go on until the job has ended.")
@with_options(SERVER)
def logs(job: int, follow: bool, as_json: bool, **server: Any) -> None:
    """Print what a job's process printed.

    \b
    Examples:
      dnrpipe logs 12
      dnrpipe logs 12 --follow
    """
    from ..service.models import FINAL

    with _client(**server) as client:
        offset, text = 0, ""
        while True:
            ended = client.job(job).state in FINAL
            page = client.log(job, offset)
            if as_json:
                text += page.text
            else:
                click.echo(page.text, nl=False)
            offset = page.next
            if offset < page.size:
                continue
            if ended or not follow:
                break
            time.sleep(0.5)
    if as_json:
        click.echo(json.dumps({"job": job, "text": text}))


@click.command()
@click.argument("job", type=click.IntRange(1))
@with_options(SERVER)
def cancel(job: int, **options: Any) -> None:
    """Cancel a queued or running job; what it made is kept.

    \b
    Examples:
      dnrpipe cancel 12
    """
    _act(lambda client: client.cancel(job), **options)


@click.command()
@click.argument("job", type=click.IntRange(1))
@with_options(SERVER)
def retry(job: int, **options: Any) -> None:
    """Queue a failed or cancelled job again; it goes on where it stopped.

    \b
    Examples:
      dnrpipe retry 12
    """
    _act(lambda client: client.retry(job), **options)


def _act(wish: Callable[[Client], Job], as_json: bool, **server: Any) -> None:
    with _client(**server) as client:
        job = wish(client)
    if as_json:
        print_json(job.model_dump(mode="json"))
    else:
        wanted = job.state == "running" and job.cancel_requested
        click.echo(f"job {job.id}: {'running, will be cancelled' if wanted else job.state}")


def _follow(client: Client, job: Job, console: Console) -> Job:
    """Show a job's progress as a local run would, until it has ended; returns the job as it is then."""
    bar: Bar | None = None
    with ExitStack() as bars:  # one at a time
        try:
            for event in client.events(job.id):
                data = event.data
                if event.kind == "progress":
                    if bar is None or bar.label != data["label"]:
                        bars.close()
                        bar = bars.enter_context(console.bar(data["label"], data["total"], data["done"]))
                    bar.advance(max(0, data["done"] - bar.done), data["note"])
                elif event.kind == "message":
                    bars.close()
                    bar = None
                    (console.warn if data["level"] == "warning" else console.say)(data["text"])
                elif event.kind == "state" and "why" in data and data["state"] == "queued":
                    bars.close()
                    bar = None
                    console.say(f"job {job.id}: queued again: {data['why']}")
        except KeyboardInterrupt:
            console.say(f"job {job.id} goes on; `dnrpipe logs {job.id} -f` shows it, `dnrpipe cancel {job.id}` ends it")
            raise
    ended = client.job(job.id)
    if ended.state == "done":
        console.say(f"job {job.id}: done")
    return ended


def _how(job: Job) -> str:
    if job.error:
        return job.error
    if job.state == "running" and job.progress:
        return f"{job.progress['label']} {job.progress['done']}/{job.progress['total']} {job.progress['note']}".rstrip()
    return time.strftime("%F %T", time.localtime(job.finished or job.created))


def _plain(name: str) -> str:
    """A file's name as a name on the server."""
    plain = re.sub(r"[^A-Za-z0-9_-]", "-", name).lstrip("-_")[:64]
    if not plain:
        raise UserError(f"{name!r}: no name for a workspace; give one with -w")
    return plain
