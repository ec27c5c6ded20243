"""A page in the machine's own Chromium, headless, driven by playwright; nothing is downloaded."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Literal

from ..core.errors import UserError

if TYPE_CHECKING:
    from playwright.sync_api import Page

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
FLAGS = ("--disable-dev-shm-usage", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
"""Software GL: checks must not depend on the machine's graphics."""

TIMEOUT = 120_000
"""Milliseconds that one call may take."""


def find_chromium() -> str | None:
    return next((path for name in NAMES if (path := shutil.which(name))), None)


def require_chromium() -> str:
    """Path of an installed Chromium. Raises UserError: there is none; ModuleNotFoundError: no playwright."""
    import playwright.sync_api  # noqa: F401

    chromium = find_chromium()
    if chromium is None:
        raise UserError(f"no Chromium here (looked for {', '.join(NAMES)}); install one to check the page")
    return chromium


@contextmanager
def open_page(
    address: str, *, width: int = 800, height: int = 900, color_scheme: Literal["light", "dark"] = "light"
) -> Iterator[tuple[Page, list[str]]]:
    """Start a Chromium with a profile of its own, load a page, and end Chromium afterwards.

    Yields the page, and a list that grows with its errors: exceptions, refused resources, console.error.
    width, height: of the viewport, CSS pixels. color_scheme: what the page's media query sees.

    Raises UserError: there is no Chromium, or a call failed: the page threw, was not found, or took too long;
    ModuleNotFoundError: playwright is not installed.
    """
    chromium = require_chromium()
    from playwright.sync_api import Error, sync_playwright

    errors: list[str] = []

    def note(message: Any) -> None:
        if message.type == "error":
            errors.append(message.text)

    try:
        with (
            sync_playwright() as playwright,
            playwright.chromium.launch(executable_path=chromium, args=FLAGS) as browser,
        ):
            page = browser.new_page(viewport={"width": width, "height": height}, color_scheme=color_scheme)
            page.set_default_timeout(TIMEOUT)
            page.on("pageerror", lambda error: errors.append(str(error)))
            page.on("console", note)
            page.goto(address)
            yield page, errors
    except Error as error:
        raise UserError(" | ".join(["Chromium says: " + error.message.splitlines()[0], *errors[-3:]])) from None


def wait_for(page: Page, expression: str) -> Any:
    """The value of a JavaScript expression once it is true; promises are waited for.

    Raises playwright's Error where it throws or takes longer than `TIMEOUT`, which `evaluate` would not notice.
    """
    return page.wait_for_function(expression).json_value()
