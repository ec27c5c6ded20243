"""The pictures of docs/service.md: dashboard on a desk and on a phone, in light and dark, and the live viewer.

python -m tools.screenshots WORKSPACE.dnr [--out docs/images]

WORKSPACE: trained and evaluated; a copy of it is served. Its fine-tuning runs anew while the first picture is taken.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

from PIL import Image
from tests.service.harness import Server

from dnrpipe.export.browser import open_page
from dnrpipe.service.models import JobRequest

OUT = Path(__file__).resolve().parents[1] / "docs" / "images"
WIDE, NARROW, HIGH = 1280, 390, 900


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        server = Server(Path(folder) / "root", "--rate", "500")
        try:
            name = options.workspace.stem
            shutil.copytree(options.workspace, server.root / f"{name}.dnr")
            with server.client() as client:
                for command, more in (("render", {"orbit": 8}), ("export-gltf", {})):
                    made = client.submit(JobRequest.model_validate({"command": command, "workspace": name, **more}))
                    for _ in client.events(made.id):
                        pass
                    assert client.job(made.id).state == "done", client.job(made.id)
                _viewer(server, name, options.out / "viewer.jpg")
                training = client.submit(JobRequest(command="finetune", workspace=name, force=True))
                _dashboard(server, name, training.id, options.out / "dashboard.png", WIDE, "light")
                client.cancel(training.id)
                _dashboard(server, name, made.id, options.out / "dashboard-phone.png", NARROW, "dark")
        finally:
            server.stop()


def _dashboard(server: Server, name: str, job: int, target: Path, width: int, scheme: str) -> None:
    with open_page(server.url, width=width, height=HIGH, color_scheme=scheme) as (page, errors):  # type: ignore[arg-type]
        row = f"document.querySelector('#jobs tr[data-job=\"{job}\"]')"
        _until(page, f"{row} !== null")
        page.evaluate(f"{row}.querySelector('button').click()")
        chosen = f"[...document.querySelectorAll('#workspaces button')].find(b => b.textContent === '{name}')"
        _until(page, f"{chosen} !== undefined")
        page.evaluate(f"{chosen}.click()")
        _until(page, f"document.querySelector('#detail-title').textContent === '{name}'")
        _until(page, "document.querySelector('#truth').naturalWidth > 0")
        if width == WIDE:
            _until(page, "Number(document.querySelector('#live').dataset.epoch) > 5")
            page.screenshot(path=str(target))
        else:
            page.screenshot(path=str(target), full_page=True)
        assert errors == [], errors


def _until(page: Any, expression: str) -> None:
    """`Page.wait_for_function` needs the eval that the pages' policy forbids."""
    deadline = time.monotonic() + 120
    while not page.evaluate(expression):
        assert time.monotonic() < deadline, expression
        page.wait_for_timeout(50)


def _viewer(server: Server, name: str, target: Path) -> None:
    with open_page(f"{server.url}/static/viewer.html?w={name}", width=WIDE, height=HIGH) as (page, errors):
        _until(page, "document.querySelector('#picture')?.dataset.fine === 'yes'")
        page.wait_for_timeout(8000)  # rays are added meanwhile
        picture = target.with_suffix(".png")
        page.screenshot(path=str(picture))
        assert errors == [], errors
    with Image.open(picture) as found:
        found.convert("RGB").save(target, quality=88)
    picture.unlink()


if __name__ == "__main__":
    main()
