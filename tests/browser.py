"""Headless Chromium for tests and for looking at pages: screenshots and the DOM after scripts ran."""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path

from dnrpipe.export.browser import find_chromium

__all__ = ["dump_dom", "find_chromium", "screenshot"]
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
)


def screenshot(page: Path, picture: Path, *, width: int, height: int, dark: bool = False) -> None:
    """Render a local HTML file to a PNG of width × height CSS pixels. Raises RuntimeError when that fails.

    Chromium's windows are at least 500 pixels wide: narrower pages are shown in a frame of that width.
    """
    dark_flags = ["--blink-settings=preferredColorScheme=0"] if dark else []
    with tempfile.TemporaryDirectory() as folder:
        target = page.resolve()
        if width < 500:
            target = Path(folder) / "frame.html"
            target.write_text(
                f'<!doctype html><body style="margin:0"><iframe src="{page.resolve().as_uri()}" '
                f'style="border:0;width:{width}px;height:{height}px"></iframe></body>',
                encoding="utf-8",
            )
        _run([*dark_flags, f"--screenshot={picture.resolve()}", f"--window-size={max(width, 500)},{height}"], target)
    if not picture.is_file():
        raise RuntimeError(f"Chromium made no screenshot of {page}")


def dump_dom(page: Path) -> str:
    """The document as HTML after its scripts ran."""
    return _run(["--dump-dom"], page.resolve())


def _run(flags: list[str], page: Path) -> str:
    chromium = find_chromium()
    if chromium is None:
        raise RuntimeError("no Chromium is installed")
    with tempfile.TemporaryDirectory() as profile:
        result = subprocess.run(
            [chromium, *FLAGS, f"--user-data-dir={profile}", *flags, page.as_uri()],
            capture_output=True,
            text=True,
            timeout=120,
        )
    if result.returncode != 0:
        raise RuntimeError(f"Chromium ended with {result.returncode}: {result.stderr[-500:]}")
    return result.stdout
