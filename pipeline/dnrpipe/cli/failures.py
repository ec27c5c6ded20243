"""Expected failures as one line and an exit code; bugs keep their traceback."""

from __future__ import annotations

import errno
import os

import click

from ..core.errors import UserError

_EXTRAS = {
    "train": ("torch",),
    "render": ("bpy", "mitsuba", "drjit", "flip_evaluator", "imageio_ffmpeg", "PIL", "jinja2", "matplotlib"),
    "export": ("onnx", "onnxruntime", "playwright"),
    "serve": ("fastapi", "uvicorn", "websockets", "httpx"),
}


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
    if isinstance(error, OSError):
        return _explain_os(error)
    return None


def _explain_os(error: OSError) -> tuple[str, int] | None:
    where = error.filename or "the workspace"
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"{where}: the disk is full; free some space and run the same command to go on", 2
    if error.errno == errno.EFBIG:
        return f"{where}: the system allows no file as large as this (`ulimit -f`); raise the limit and run again", 2
    if error.errno == errno.EIO:
        return f"{where}: cannot be read or written ({error.strerror or error}); check the disk", 2
    if error.errno in (errno.EACCES, errno.EROFS, errno.EPERM):
        return f"{where}: cannot be written (read-only or not yours); choose another folder with -w", 2
    if error.errno in (errno.ENOTDIR, errno.EISDIR):
        return f"{where}: {os.strerror(error.errno).lower()}", 2
    return None
