"""Options that several commands share, and what they mean as settings."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dnrtrain.selector.names import NAMES

from ..core.errors import UserError

if TYPE_CHECKING:
    from ..core.settings import Settings
    from ..stages.session import Session

SAMPLES_AT_ONCE = 8
"""The least that is traced towards a target: schedule.STEP, which is not imported for --help."""


def options(options: list[Any]) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    return lambda function: reduce(lambda decorated, option: option(decorated), reversed(options), function)


class Budget(click.ParamType):
    """A number of views, or ``auto``."""

    name = "budget"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        try:
            return value if value == "auto" else int(value)
        except ValueError:
            self.fail(f"'{value}' is neither a number of views nor auto", param, ctx)


WORKSPACE = click.option("-w", "--workspace", metavar="DIR", help="The workspace folder (scene.dnr).")
OUTPUT_OPTIONS = [
    click.option("--json", "as_json", is_flag=True, help="Print one JSON value; messages to stderr."),
    click.option("-q", "--quiet", is_flag=True, help="Warnings and errors only."),
]
EXECUTOR_OPTIONS = [
    click.option("--executor", type=click.Choice(["local", "ray"]), help="Where task lists run (default local)."),
    click.option("--address", metavar="WHERE", help="Ray cluster: local (default), auto or HOST:PORT."),
    click.option("--shared", is_flag=True, help="All nodes of it see the workspace under the same path."),
]
"""What `executor_assignments` reads."""
common = options(
    [
        WORKSPACE,
        click.option(
            "--preset", metavar="NAME", help="draft (default), standard, paper, vanilla, paper-128 or vanilla-128."
        ),
        click.option(
            "--set",
            "assignments",
            multiple=True,
            metavar="KEY=VALUE",
            help="Any setting, e.g. --set finetune.step2.epochs=20. Repeatable; remembered.",
        ),
        click.option("--force", is_flag=True, help="Do it again, reusing nothing."),
        *EXECUTOR_OPTIONS,
        *OUTPUT_OPTIONS,
    ]
)
"""Options every stage has."""
SCENE_OPTIONS = [
    click.argument("scene", type=click.Path(path_type=Path), required=False),
    click.option("--strict", is_flag=True, help="Refuse a scene with missing files or anything ignored. Remembered."),
    click.option(
        "--cameras",
        metavar="SOURCE",
        help="auto (default: inside for rooms and animated cameras, else dome), dome, sphere, inside, scene, animation,"
        " or a NeRF transforms.json.",
    ),
    click.option("--views", type=int, metavar="N", help="Number of candidate views."),
    click.option("--resolution", type=int, metavar="PIXELS", help="Square image size."),
    click.option("--raster", type=click.Choice(["auto", "eevee", "workbench", "cycles-direct"])),
]
"""Options of commands that may start from a scene file; `scene_overrides` reads them."""
SELECT_OPTIONS = [
    click.option(
        "--budget",
        type=Budget(),
        metavar="M",
        help="Views to ray-trace (default 25); 0: none, no training; auto: as many as are worth their seconds.",
    ),
    click.option(
        "--policy",
        type=click.Choice(NAMES),
        help="How to choose them; rl-paper trains for it, the others take seconds.",
    ),
]


def print_json(value: Any) -> None:
    """The command's JSON answer."""
    click.echo(json.dumps(value, indent=2))


def open_session(
    command: str,
    options: dict[str, Any],
    *,
    scene: Path | None = None,
    overrides: dict[str, Any] | None = None,
    late: Callable[[Settings], dict[str, Any]] | None = None,
) -> Session:
    """The command's hold on its workspace. ``late``: overrides that depend on the settings as they are."""
    from ..stages.session import Session

    options["assignments"] = (*executor_assignments(options), *options["assignments"])
    return Session(command, options, scene, overrides or {}, late)


def executor_assignments(options: dict[str, Any]) -> list[str]:
    """The flags as settings; they are taken out of the options."""
    engine, address, shared = (options.pop(name, None) for name in ("executor", "address", "shared"))
    given = [] if engine is None else [f"executor.engine={engine}"]
    given += [] if address is None else [f'executor.address="{address}"']
    return [*given, "executor.shared=true"] if shared else given


@contextmanager
def open_prepared(command: str, scene: Path | None, options: dict[str, Any]) -> Iterator[Session]:
    """The session of a command that takes a scene file or a workspace, once stage prepare is done."""
    if scene is not None and (scene / "manifest.json").exists():
        options["workspace"], scene = str(scene), None
    with open_session(command, options, scene=scene, overrides=scene_overrides(options)) as session:
        session.stages("prepare")
        yield session


def scene_overrides(options: dict[str, Any]) -> dict[str, Any]:
    cameras: dict[str, Any] = {}
    source = options.pop("cameras")
    if source is not None:
        from ..core.cameras import KEYWORDS

        if source in KEYWORDS:
            cameras |= {"source": source, "source_sha256": ""}
        elif Path(source).is_file():
            cameras |= {"source": str(Path(source).resolve())}
        else:
            raise UserError(f"--cameras {source}: neither {', '.join(KEYWORDS)} nor a camera file")
    views, resolution, raster = options.pop("views"), options.pop("resolution"), options.pop("raster")
    if views is not None:
        cameras["train"] = views
    if resolution is not None:
        cameras |= {"width": resolution, "height": resolution}
    overrides: dict[str, Any] = {"cameras": cameras} if cameras else {}
    if raster is not None:
        overrides["passes"] = {"raster": raster}
    if options.pop("strict"):
        overrides["strict"] = True
    return overrides


def select_overrides(options: dict[str, Any]) -> dict[str, Any]:
    chosen = {key: options.pop(key) for key in ("budget", "policy")}
    given = {key: value for key, value in chosen.items() if value is not None}
    budget = given.get("budget", 0)
    if budget != "auto" and budget < 0:
        raise UserError(f"--budget {budget}: must be at least 0 views")
    return {"select": given} if given else {}


def tracing_overrides(noise: str | None, time: str | None, spp: int | None, denoise: str | None) -> dict[str, Any]:
    """How far views are traced. Flags name one wish together: what they leave out of it is forgotten."""
    from ..core.units import parse_seconds, parse_share

    raytrace: dict[str, Any] = {}
    if noise is not None or time is not None:
        raytrace = {"noise": amount("--noise", noise, parse_share), "time": amount("--time", time, parse_seconds)}
        if spp is not None:
            if spp < SAMPLES_AT_ONCE:
                raise UserError(f"--spp {spp}: with --noise or --time at least {SAMPLES_AT_ONCE}, one in each group")
            raytrace["max_spp"] = spp
    elif spp is not None:
        if spp < 1:
            raise UserError(f"--spp {spp}: must be at least 1")
        raytrace = {"spp": spp, "noise": None, "time": None}
    if denoise is not None:
        raytrace["denoise"] = denoise == "oidn"
    return {"raytrace": raytrace} if raytrace else {}


def amount(flag: str, text: str | None, parse: Callable[[str], float]) -> float | None:
    """What ``parse`` reads; None stays None. Raises UserError that names the flag."""
    try:
        return None if text is None else parse(text)
    except ValueError as error:
        raise UserError(f"{flag} {text}: {error}") from None
