"""The command line: a thin click command per stage. Heavy imports happen inside commands.

Exit codes: 0 done; 1 some views failed; 2 bad input (one line says what, where, what to do); 130 Ctrl-C.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from . import __version__
from .errors import UserError

if TYPE_CHECKING:
    from .session import Session


class _Group(click.Group):
    """Lists commands in pipeline order, not alphabetically."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.commands)


@click.group(cls=_Group, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="dnrpipe")
def cli() -> None:
    """Turn a .blend file into a fast neural renderer, ray-tracing only the views that matter.

    \b
    Examples:
      dnrpipe run scene.blend --budget 25      # everything, one command
      dnrpipe prepare scene.blend              # or stage by stage:
      dnrpipe select --budget 25
      dnrpipe raytrace-selected
      dnrpipe finetune
      dnrpipe evaluate && dnrpipe report

    Commands find their workspace (scene.dnr) by -w, by DNRPIPE_WORKSPACE, by standing in it, or as the only
    *.dnr here. Interrupted commands go on where they stopped when run again.
    """


def _common(function: Callable[..., Any]) -> Callable[..., Any]:
    """Options every stage has."""
    for option in reversed(
        [
            click.option("-w", "--workspace", metavar="DIR", help="The workspace folder (scene.dnr)."),
            click.option("--preset", metavar="NAME", help="draft (default), standard or paper."),
            click.option(
                "--set",
                "assignments",
                multiple=True,
                metavar="KEY=VALUE",
                help="Any setting, e.g. --set finetune.step2.epochs=20. Repeatable; remembered.",
            ),
            click.option("--force", is_flag=True, help="Do it again, reusing nothing."),
            click.option("--json", "as_json", is_flag=True, help="Print one JSON value; messages to stderr."),
            click.option("-q", "--quiet", is_flag=True, help="Warnings and errors only."),
        ]
    ):
        function = option(function)
    return function


_CAMERA_OPTIONS = [
    click.option(
        "--cameras",
        metavar="SOURCE",
        help="dome (default), sphere, scene, animation, or a NeRF transforms.json.",
    ),
    click.option("--views", type=int, metavar="N", help="Number of candidate views."),
    click.option("--resolution", type=int, metavar="PIXELS", help="Square image size."),
    click.option("--raster", type=click.Choice(["auto", "eevee", "workbench", "cycles-direct"])),
]
_SELECT_OPTIONS = [
    click.option("--budget", type=int, metavar="M", help="Views to ray-trace (default 25)."),
    click.option("--policy", type=click.Choice(["rl", "random", "farthest"]), help="How to choose them."),
]


def _options(options: list[Any]) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        for option in reversed(options):
            function = option(function)
        return function

    return decorate


@cli.command()
@click.argument("scene", type=click.Path(path_type=Path), required=False)
@_options(_CAMERA_OPTIONS)
@_common
def prepare(scene: Path | None, **options: Any) -> None:
    """Convert a scene and render the cheap passes of all candidate views.

    SCENE is a .blend, .obj, .gltf, .glb, .fbx, .ply or .stl file. Makes ./SCENE.dnr (or -w DIR) with the
    census, a Mitsuba bundle, cameras, and per view a G-buffer (UV, depth, normal) and rasterised colour.
    Embedded scripts are never executed. Without SCENE, goes on with the workspace's own scene.

    \b
    Examples:
      dnrpipe prepare scene.blend
      dnrpipe prepare scene.blend --preset standard --resolution 512
      dnrpipe prepare scene.blend --cameras transforms_train.json
    """
    with _session("prepare", options, scene=scene, overrides=_camera_overrides(options)) as session:
        session.stages("prepare")


@cli.command()
@_options(_SELECT_OPTIONS)
@_common
def select(**options: Any) -> None:
    """Step 1: train the coarse neural renderer and choose the views to ray-trace.

    \b
    Examples:
      dnrpipe select --budget 25
      dnrpipe select --budget 10 --policy farthest
    """
    with _session("select", options, overrides=_select_overrides(options)) as session:
        session.stages("select")


@cli.command("raytrace-selected")
@click.option("--spp", type=int, metavar="N", help="Samples per pixel.")
@_common
def raytrace_selected(spp: int | None, **options: Any) -> None:
    """Path-trace the selected views with Mitsuba, and no others.

    \b
    Examples:
      dnrpipe raytrace-selected
      dnrpipe raytrace-selected --spp 512
    """
    overrides: dict[str, Any] = {"raytrace": {"spp": spp}} if spp is not None else {}
    with _session("raytrace-selected", options, overrides=overrides) as session:
        session.stages("raytrace")


@cli.command()
@click.option("--epochs", type=int, metavar="N", help="Passes over the selected views.")
@_common
def finetune(epochs: int | None, **options: Any) -> None:
    """Step 2: fine-tune the neural renderer on the ray-traced views with six losses.

    \b
    Examples:
      dnrpipe finetune
      dnrpipe finetune --epochs 100 --set finetune.step2.augment=false
    """
    overrides: dict[str, Any] = {"finetune": {"step2": {"epochs": epochs}}} if epochs is not None else {}
    with _session("finetune", options, overrides=overrides) as session:
        session.stages("finetune")


@cli.command()
@_common
def evaluate(**options: Any) -> None:
    """Measure on held-out test views, ray-traced on demand and booked as evaluation cost.

    \b
    Examples:
      dnrpipe evaluate
      dnrpipe evaluate --json | jq .evaluate.mean.psnr
    """
    with _session("evaluate", options) as session:
        session.stages("evaluate")


@cli.command()
@click.option("--orbit", type=click.IntRange(1, 100_000), metavar="N", help="N frames of a turntable (default 60).")
@click.option("--elevation", type=click.FloatRange(-89, 89), default=25.0, show_default=True, metavar="DEGREES")
@click.option("--cameras", "camera_file", type=click.Path(path_type=Path), help="A NeRF transforms.json instead.")
@click.option("--frames", type=click.Choice(["png", "exr", "both"]), default="png", show_default=True)
@click.option("--movie", type=click.Choice(["mp4", "webp", "none"]), default="mp4", show_default=True)
@click.option(
    "--resolution", type=click.IntRange(8, 16384), metavar="PIXELS", help="Square size of the orbit's frames."
)
@_common
def render(
    orbit: int | None,
    elevation: float,
    camera_file: Path | None,
    frames: str,
    movie: str,
    resolution: int | None,
    **options: Any,
) -> None:
    """Render novel views with the neural renderer: frames and a movie in renders/.

    \b
    Examples:
      dnrpipe render --orbit 60
      dnrpipe render --orbit 120 --movie webp --frames both
      dnrpipe render --cameras transforms_path.json
    """
    if orbit is not None and camera_file is not None:
        raise UserError("render: give --orbit or --cameras, not both")
    with _session("render", options) as session:
        session.render(orbit or 60, elevation, camera_file, frames, movie, resolution)


@cli.command()
@_common
def report(**options: Any) -> None:
    """Write one self-contained HTML report: pictures, quality, and what it cost in time.

    \b
    Examples:
      dnrpipe report
      dnrpipe report -w scene.dnr --json
    """
    with _session("report", options) as session:
        session.report()


@cli.command()
@click.argument("scene", type=click.Path(path_type=Path), required=False)
@_options([*_CAMERA_OPTIONS, *_SELECT_OPTIONS])
@_common
def run(scene: Path | None, **options: Any) -> None:
    """All stages: prepare, select, raytrace-selected, finetune, evaluate, report.

    Does only what is missing or out of date.

    \b
    Examples:
      dnrpipe run scene.blend --budget 25
      dnrpipe run scene.blend --preset paper
    """
    from .settings import merge

    overrides = merge(_camera_overrides(options), _select_overrides(options))
    with _session("run", options, scene=scene, overrides=overrides) as session:
        session.stages("prepare", "select", "raytrace", "finetune", "evaluate")
        session.report()


@cli.command()
@click.option("-w", "--workspace", metavar="DIR", help="The workspace folder (scene.dnr).")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def status(workspace: str | None, as_json: bool) -> None:
    """Show what is done, partial, stale or missing, and the next command.

    \b
    Examples:
      dnrpipe status
      dnrpipe status --json
    """
    from . import stages
    from .console import clock
    from .session import resolve_settings
    from .workspace import Workspace, find_workspace

    found = Workspace.open(find_workspace(workspace))
    rows = stages.status(found, resolve_settings(found, {}, None))
    if as_json:
        click.echo(json.dumps({"workspace": str(found.root), "stages": rows}, indent=2))
        return
    click.echo(f"{found.root}  (from {found.manifest.source.path})")
    for row in rows:
        took = clock(row["seconds"]) if row["seconds"] is not None else "-"
        click.echo(
            f"  {row['state']:8} {row['command']:18} {row['present']:>4}/{row['wanted']:<4} {took:>7}  {row['does']}"
        )
    due = next((row for row in rows if row["state"] != "done"), None)
    click.echo(f"next: dnrpipe {due['command']}" if due else "next: dnrpipe render --orbit 60, or dnrpipe report")


@cli.command()
@click.option("-w", "--workspace", metavar="DIR", help="The workspace folder (scene.dnr).")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def costs(workspace: str | None, as_json: bool) -> None:
    """Sum the ledger: where the time went.

    \b
    Examples:
      dnrpipe costs
      dnrpipe costs --json | jq .
    """
    from .costs import summarise
    from .workspace import Workspace, find_workspace

    found = Workspace.open(find_workspace(workspace))
    prepared = found.manifest.stages.get("prepare")
    chosen = found.manifest.stages.get("raytrace")
    summary = summarise(
        found.ledger.read(),
        n_candidates=prepared.detail["views"]["train"] if prepared else None,
        only={f"train/{name}" for name in chosen.detail["views"]} if chosen else None,
        torn_lines=found.ledger.torn_lines(),
    )
    click.echo(json.dumps(summary, indent=2) if as_json else _costs_table(summary))


def _costs_table(summary: dict[str, Any]) -> str:
    from .console import clock

    lines = [f"{'stage':10} {'for':12} {'units':>6} {'wall':>8} {'cpu':>8}"]
    for stage, purposes in summary["by_stage_and_purpose"].items():
        for purpose, part in purposes.items():
            lines.append(
                f"{stage:10} {purpose:12} {part['records']:>6} {clock(part['wall_seconds']):>8}"
                f" {clock(part['cpu_seconds']):>8}"
            )
    whole = summary["total"]
    lines.append(
        f"{'total':23} {whole['records']:>6} {clock(whole['wall_seconds']):>8} {clock(whole['cpu_seconds']):>8}"
    )
    tracing = summary["tracing_all"]
    if tracing:
        lines.append(
            f"ray-traced {tracing['views']} of {tracing['candidates']} candidates in"
            f" {tracing['actual_seconds']:.1f} s; all would have cost {tracing['all_seconds']:.1f} s"
        )
    return "\n".join(lines)


@cli.command()
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def doctor(as_json: bool) -> None:
    """Check this machine: Blender, EEVEE, Mitsuba variants, torch, weights, disk.

    \b
    Examples:
      dnrpipe doctor
      dnrpipe doctor --json
    """
    from .doctor import examine

    checks = examine()
    if as_json:
        click.echo(json.dumps(checks, indent=2))
    else:
        for check in checks:
            click.echo(f"{check['state']:5} {check['name']:18} {check['text']}")
    if any(check["state"] == "fail" for check in checks):
        raise SystemExit(1)


@cli.command()
@click.option("--offline", is_flag=True, help="Only check what is cached.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def weights(offline: bool, as_json: bool) -> None:
    """Fetch the VGG16, AlexNet and LPIPS weights into the cache (~/.cache/dnrpipe or DNRPIPE_CACHE).

    Needed for the perceptual loss and LPIPS. Without them, training says so and drops both.

    \b
    Examples:
      dnrpipe weights
      dnrpipe weights --offline
    """
    from dnrtrain.weights import WeightsMissing, ensure_weights

    try:
        found = ensure_weights(offline=offline)
    except WeightsMissing as error:
        raise UserError(str(error)) from None
    click.echo(
        json.dumps(found, indent=2, default=str) if as_json else "\n".join(f"{k}: {v}" for k, v in found.items())
    )


def _session(
    command: str,
    options: dict[str, Any],
    *,
    scene: Path | None = None,
    overrides: dict[str, Any] | None = None,
) -> Session:
    from .session import Session

    return Session(command, options, scene, overrides or {})


def _camera_overrides(options: dict[str, Any]) -> dict[str, Any]:
    cameras: dict[str, Any] = {}
    source = options.pop("cameras")
    if source is not None:
        from .cameras import KEYWORDS

        if source not in KEYWORDS and not Path(source).is_file():
            raise UserError(f"--cameras {source}: neither {', '.join(KEYWORDS)} nor a camera file")
        if source in KEYWORDS:
            cameras |= {"source": source, "source_sha256": ""}
        else:
            from .workspace import file_sha256

            cameras |= {"source": str(Path(source).resolve()), "source_sha256": file_sha256(Path(source))}
    views, resolution, raster = options.pop("views"), options.pop("resolution"), options.pop("raster")
    if views is not None:
        cameras["train"] = views
    if resolution is not None:
        cameras |= {"width": resolution, "height": resolution}
    overrides: dict[str, Any] = {"cameras": cameras} if cameras else {}
    if raster is not None:
        overrides["passes"] = {"raster": raster}
    return overrides


def _select_overrides(options: dict[str, Any]) -> dict[str, Any]:
    chosen = {key: options.pop(key) for key in ("budget", "policy")}
    if chosen["budget"] is not None and chosen["budget"] < 1:
        raise UserError(f"--budget {chosen['budget']}: must be at least 1 view")
    given = {key: value for key, value in chosen.items() if value is not None}
    return {"select": given} if given else {}


def main(arguments: list[str] | None = None) -> None:
    """Entry point: runs the command and turns every expected failure into one line and an exit code."""
    code = _main(arguments)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # all is written; a late Ctrl-C must not spoil the exit code
    sys.exit(code)


def _main(arguments: list[str] | None) -> int:
    from .interrupts import interrupt_as_keyboard

    try:
        with interrupt_as_keyboard():
            cli.main(args=arguments, standalone_mode=False, prog_name="dnrpipe")
    except click.exceptions.Exit as error:
        return error.exit_code
    except (KeyboardInterrupt, click.Abort):
        return _fail("interrupted; run the same command to go on where it stopped", 130)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # a reader such as `head` left: no noise at exit
    except Exception as error:
        from .failures import explain

        explained = explain(error)
        if explained is None:
            raise
        return _fail(*explained)
    return 0


def _fail(message: str, code: int) -> int:
    print(f"dnrpipe: error: {message}" if code != 130 else f"dnrpipe: {message}", file=sys.stderr, flush=True)
    return code


if __name__ == "__main__":
    main()
