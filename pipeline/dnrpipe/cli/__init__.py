"""The command line: a thin click command per stage. Heavy imports happen inside commands.

Exit codes: 0 done; 1 some views failed; 2 bad input (one line says what, where, what to do); 130 Ctrl-C.
"""

from __future__ import annotations

import errno
import os
import signal
import sys
from collections.abc import MutableMapping

import click

from .. import __version__
from ..core.errors import UserError
from . import information, stages
from .export import export_gltf, export_nerf, export_onnx, export_web
from .fleet import batch
from .plan import frontier, plan
from .service import cancel, jobs, logs, retry, serve, submit
from .shot import shot
from .studies import ablate, bench_select
from .worker import worker

_EXTRAS = {
    "train": ("torch",),
    "render": ("bpy", "mitsuba", "drjit", "flip_evaluator", "imageio_ffmpeg", "PIL", "jinja2", "matplotlib"),
    "export": ("onnx", "onnxruntime", "playwright"),
    "ray": ("ray",),
    "serve": ("fastapi", "uvicorn", "websockets", "httpx"),
}
"""What an optional dependency belongs to."""


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


for _command in (
    information.inspect,
    stages.prepare,
    information.effects,
    stages.select,
    stages.raytrace_selected,
    stages.finetune,
    stages.evaluate,
    stages.render,
    stages.report,
    shot,
    export_nerf,
    export_onnx,
    export_gltf,
    export_web,
    stages.run,
    batch,
    plan,
    frontier,
    ablate,
    bench_select,
    *(serve, worker, submit, jobs, logs, cancel, retry),
    information.status,
    information.verify,
    information.costs,
    information.doctor,
    information.weights,
):
    cli.add_command(_command)


def main(arguments: list[str] | None = None) -> None:
    """Entry point: runs the command and turns every expected failure into one line and an exit code."""
    set_thread_waiting(os.environ)
    code = _main(arguments)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # all is written; a late Ctrl-C must not spoil the exit code
    sys.exit(code)


def _main(arguments: list[str] | None) -> int:
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    previous = signal.signal(signal.SIGTERM, stop)  # SIGTERM ends a command as Ctrl-C does
    try:
        cli.main(args=arguments, standalone_mode=False, prog_name="dnrpipe")
    except click.exceptions.Exit as error:
        return error.exit_code
    except (KeyboardInterrupt, click.Abort):
        return _fail("interrupted; run the same command to go on where it stopped", 130)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # a reader such as `head` left: no noise at exit
    except Exception as error:
        explained = explain(error)
        if explained is None:
            raise
        return _fail(*explained)
    finally:
        signal.signal(signal.SIGTERM, previous)
    return 0


def _fail(message: str, code: int) -> int:
    print(f"dnrpipe: error: {message}" if code != 130 else f"dnrpipe: {message}", file=sys.stderr, flush=True)
    return code


def explain(error: Exception) -> tuple[str, int] | None:
    """(one line, exit code) for a failure that we expect; None for a bug, which keeps its traceback."""
    from dnrtrain.contract import ContractError

    from ..workers.view_tasks import TasksFailed

    if isinstance(error, UserError | ContractError):
        return str(error), 2
    if isinstance(error, TasksFailed):
        return str(error), 1
    if isinstance(error, click.UsageError):
        command = error.ctx.command_path if error.ctx else "dnrpipe"
        return f"{error.format_message()} See `{command} --help`.", 2
    if isinstance(error, click.ClickException):
        return error.format_message(), 2
    if isinstance(error, ModuleNotFoundError):
        module = (error.name or "").split(".")[0]
        for extra, modules in _EXTRAS.items():
            if module in modules:
                return f"{module} is not installed; run `pip install 'dnrpipe[{extra}]'`", 2
    if not isinstance(error, OSError):
        return None
    where = error.filename or "the workspace"
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"{where}: the disk is full; free some space and run the same command to go on", 2
    if error.errno == errno.EFBIG:
        return f"{where}: the system allows no file as large as this (`ulimit -f`); raise the limit and run again", 2
    if error.errno == errno.EIO:
        return f"{where}: cannot be read or written ({error.strerror or error}); check the disk", 2
    if error.errno in (errno.EACCES, errno.EROFS, errno.EPERM):
        return f"{where}: cannot be written (read-only or not yours); choose another folder with -w", 2
    if error.errno == errno.EEXIST:
        return f"{where}: is there already, and no folder of ours; name another place", 2
    if error.errno in (errno.ENOTDIR, errno.EISDIR):
        return f"{where}: {os.strerror(error.errno).lower()}", 2
    return None


def set_thread_waiting(environment: MutableMapping[str, str]) -> None:
    """Make torch's threads spin a little, then sleep; read when torch is loaded. What the user has set stays.

    Torch for Linux comes with GNU's OpenMP, which takes a number of spins; other runtimes only sleep at once or never.
    Measured on two cores, a training step at 128², ms (`python -m tools.bench_waiting WORKSPACE`):

        spins before sleeping       0    1,000   300,000 (libgomp's default)
        idle machine               86       49        42
        four other processes      288      361       878

    One run each. Beside other processes it varies by half; spinning a little costs some there, spinning on threefold.
    """
    if "OMP_WAIT_POLICY" in environment or "GOMP_SPINCOUNT" in environment:
        return
    if sys.platform.startswith("linux"):
        environment["GOMP_SPINCOUNT"] = "1000"
    else:
        environment["OMP_WAIT_POLICY"] = "PASSIVE"
