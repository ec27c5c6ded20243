"""The live viewer, by its WebSocket and by a real browser; and the dashboard."""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import time
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from axe_playwright_python.sync_playwright import Axe
from PIL import Image
from playwright.sync_api import Page, Route
from tests.plan_record import write_plan
from tests.service.harness import Server, empty_workspace
from tests.service.test_planned import prediction
from websockets.sync.client import connect

from dnrpipe.export.browser import find_chromium, open_page
from dnrpipe.service.live_pool import BUDGET, LEVELS, MIN_FRAMES, START, Pace
from dnrpipe.service.models import JobRequest
from dnrpipe.service.routes_live import unpack
from dnrpipe.service.server import HEAD_SECONDS

needs_chromium = pytest.mark.skipif(find_chromium() is None, reason="no Chromium")


class Viewer:
    """The client's side of the WebSocket."""

    def __init__(self, socket: Any) -> None:
        self.socket = socket
        self.hello = json.loads(socket.recv(timeout=60))
        assert self.hello["kind"] == "hello", self.hello

    def ask(self, mode: str = "neural", *, azimuth: float = 0.0, size: int = 64, moving: bool = False) -> None:
        camera = {
            "azimuth": azimuth,
            "elevation": 0.5,
            "distance": self.hello["distance"],
            "target": self.hello["center"],
        }
        self.socket.send(json.dumps({"camera": camera, "size": size, "mode": mode, "moving": moving}))

    def frame(self, refined: bool = False) -> tuple[dict[str, Any], np.ndarray]:
        """(header, picture [H, W, 3] in [0, 1]). refined: also frames that add samples to the one before."""
        while True:
            message = self.socket.recv(timeout=120)
            assert isinstance(message, bytes), message
            header, data = unpack(message)
            if refined or not header["refined"]:
                break
        picture = Image.open(io.BytesIO(data))
        assert picture.get_format_mimetype() == header["type"]
        return header, np.asarray(picture.convert("RGB"), np.float32) / 255


def test_frames(server: Server, trained: str) -> None:
    """A view at rest is what `dnrpipe render` makes; all modes answer; a moving camera is quick, then fine."""
    url = server.url.replace("http", "ws") + f"/workspaces/{trained}/live"
    with connect(url, max_size=None) as socket:
        viewer = Viewer(socket)
        viewer.ask()
        header, neural = viewer.frame()
        assert header["type"] == "image/webp" and neural.shape == (64, 64, 3)
        assert {"base image", "network", "encoding"} <= set(header["ms"]) and header["nearest"]
        assert neural.std() > 0.02
        viewer.ask(azimuth=1.5)
        _, turned = viewer.frame()
        assert np.abs(neural - turned).max() > 0.1
        pictures = {}
        for mode in viewer.hello["modes"]:
            viewer.ask(mode)
            header, pictures[mode] = viewer.frame()
            assert header["mode"] == mode and header["moving"] is False
            viewer.ask(azimuth=0.1)  # ends the refinement of a reference
            while viewer.frame()[0]["mode"] != "neural":
                pass
        assert np.abs(pictures["neural"] - neural).max() < 0.02
        assert np.abs(pictures["base"] - pictures["neural"]).mean() < 0.1  # the network corrects it
        assert np.abs(pictures["normal"] - pictures["neural"]).mean() > 0.05
        viewer.ask(moving=True)
        header, _ = viewer.frame()
        assert header["moving"] and header["type"] == "image/jpeg"
        header, picture = viewer.frame()  # of the server's own accord, when nothing more comes
        assert header["moving"] is False and np.abs(picture - neural).max() < 0.02


def test_a_reference_gets_better(server: Server, trained: str) -> None:
    url = server.url.replace("http", "ws") + f"/workspaces/{trained}/live"
    with connect(url, max_size=None) as socket:
        viewer = Viewer(socket)
        viewer.ask("reference", azimuth=2.5)  # a view that has no samples yet
        frames = [viewer.frame(refined=True) for _ in range(12)]
        assert [header["spp"] for header, _ in frames] == [4 * (i + 1) for i in range(12)]
        last = frames[-1][1]
        errors = [float(np.square(picture - last).mean()) for _, picture in frames]
        assert errors[0] > 2 * errors[5] > 0


def test_a_view_at_rest_gathers_rays(server: Server, trained: str) -> None:
    """Up to 64 rays a pixel, closer and closer to what they show; a moving camera's frames remember, too."""
    url = server.url.replace("http", "ws") + f"/workspaces/{trained}/live"
    with connect(url, max_size=None) as socket:
        viewer = Viewer(socket)
        viewer.ask("base", azimuth=2.0)
        frames = [viewer.frame(refined=True) for _ in range(32)]
        assert [header["rays"] for header, _ in frames] == [2 * (i + 1) for i in range(32)], "two rays a frame"
        assert [header["refined"] for header, _ in frames] == list(range(32))
        with pytest.raises(TimeoutError):
            socket.recv(timeout=1)
        errors = [float(np.square(picture - frames[-1][1]).mean()) for _, picture in frames]
        assert errors[0] > 2 * errors[5] > 4 * errors[20]
        for azimuth in (2.02, 2.04):
            viewer.ask("base", azimuth=azimuth, moving=True)
            header, _ = viewer.frame()
        assert header["moving"] and header["rays"] > header["samples"]


def test_bad_requests_do_no_harm(server: Server, trained: str) -> None:
    url = server.url.replace("http", "ws") + f"/workspaces/{trained}/live"
    good = {"azimuth": 0, "elevation": 0, "distance": 1, "target": [0, 0, 0]}
    with connect(url, max_size=None) as socket:
        viewer = Viewer(socket)
        for text in (
            "no json",
            "{}",
            json.dumps({"camera": good | {"elevation": 2}, "size": 64}),
            json.dumps({"camera": good, "size": 100_000}),
            json.dumps({"camera": good | {"distance": float("nan")}, "size": 64}),
            json.dumps({"camera": good, "size": 64, "mode": "../../etc/passwd"}),
            json.dumps({"camera": good | {"target": [1e300, 0, 0]}, "size": 64}),
            json.dumps({"camera": good | {"distance": 1e-300}, "size": 64}),
            json.dumps({"camera": good | {"distance": 1e-8, "target": [1e6, 0, 0]}, "size": 64}),
        ):
            socket.send(text)
            answer = json.loads(socket.recv(timeout=60))
            assert answer["kind"] == "problem" and answer["detail"]
        viewer.ask()
        assert viewer.frame()[0]["mode"] == "neural"


@pytest.mark.robustness
def test_a_viewer_stays_connected(server: Server, trained: str) -> None:
    """Longer than a slow sender may take: a socket is no request that does not come."""
    with connect(server.url.replace("http", "ws") + f"/workspaces/{trained}/live", max_size=None) as socket:
        viewer = Viewer(socket)
        time.sleep(HEAD_SECONDS + 1)
        viewer.ask()
        assert viewer.frame()[0]["mode"] == "neural"


def test_untrained_workspace_says_so(server: Server) -> None:
    empty_workspace(server.root, "untrained")
    with connect(server.url.replace("http", "ws") + "/workspaces/untrained/live") as socket:
        assert "no renderer" in json.loads(socket.recv(timeout=60))["detail"]


def test_frame_process_is_replaced_when_it_dies(server: Server, trained: str) -> None:
    url = server.url.replace("http", "ws") + f"/workspaces/{trained}/live"
    with connect(url, max_size=None) as socket:
        viewer = Viewer(socket)
        viewer.ask()
        viewer.frame()
        killed = [p for p in _children(server.process.pid) if b"dnrpipe.service.live_frames" in p[1]]
        assert len(killed) == 1
        os.kill(killed[0][0], 9)
        viewer.ask(azimuth=0.2)
        assert viewer.frame()[0]["mode"] == "neural"


def _children(parent: int) -> list[tuple[int, bytes]]:
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            if int((entry / "stat").read_text().rpartition(")")[2].split()[1]) == parent:
                found.append((int(entry.name), (entry / "cmdline").read_bytes()))
        except OSError:
            continue
    return found


def test_pace() -> None:
    """Slow frames make it coarser, quick ones finer, and it settles where frames fit into the budget."""
    pace = Pace()
    cost = {0: 400.0, 1: 110.0, 2: 60.0, 3: 40.0, 4: 30.0, 5: 25.0, 6: 20.0, 7: 18.0}
    for _ in range(10 * MIN_FRAMES):
        pace.record(256, cost[pace.level])
    assert pace.level == 2
    for _ in range(20 * MIN_FRAMES):
        pace.record(256, 20 * cost[pace.level])
    assert pace.level == len(LEVELS) - 1 and pace.pick(256) == (128, 1)
    for _ in range(20 * MIN_FRAMES):
        pace.record(256, 0.01 * cost[pace.level])
    assert pace.level == 0 and pace.pick(256) == (256, None)
    first = Pace()
    first.record(256, 100 * BUDGET)  # compiles the kernels
    assert first.level == START and first._mean is None
    for _ in range(MIN_FRAMES):
        first.record(256, 0.6 * BUDGET)
        first.record(256, 2.5 * BUDGET if _ == 0 else 0.6 * BUDGET)  # one more that compiled
    assert first.level == START
    first.record(256, 2.5 * BUDGET)
    first.record(256, 2.5 * BUDGET)  # two on end: at once
    assert first.level == START + 1


def wait_for(page: Page, expression: str, seconds: float = 120) -> None:
    """Until the expression is true. `Page.wait_for_function` needs the eval that the pages' policy forbids."""
    deadline = time.monotonic() + seconds
    while not page.evaluate(expression):
        assert time.monotonic() < deadline, f"{expression}; the page says:\n{page.inner_text('body')}"
        page.wait_for_timeout(50)


@needs_chromium
def test_dashboard_and_viewer_in_a_browser(server: Server, trained: str) -> None:
    """Jobs and a workspace are shown, the slider slides, the sphere turns, and a drag changes the picture."""
    with open_page(server.url, width=1280) as (page, errors):
        wait_for(page, f"[...document.querySelectorAll('#jobs td')].some(td => td.textContent === 'run {trained}')")
        page.evaluate(
            f"[...document.querySelectorAll('#jobs tr')].find(r => r.textContent.includes('run {trained}')).click()"
        )
        wait_for(page, "document.querySelectorAll('#curves svg polyline').length > 0")
        wait_for(page, "document.querySelector('#truth').naturalWidth > 0")
        wait_for(page, "document.querySelector('#note').textContent === 'done'")
        wait_for(page, "document.querySelector('#live-prediction').naturalWidth === 48")
        caption = page.evaluate("document.querySelector('#live-caption').textContent")
        assert caption.startswith("Test view ") and "epoch 40 of 40" in caption and "will ray-trace" in caption
        assert page.evaluate("document.querySelector('#live-beside').hidden && !document.querySelector('#live').hidden")
        assert page.evaluate("document.querySelector('#plan').hidden")
        assert "Ray-traced 2 of 4 candidates" in page.evaluate("document.querySelector('#cost').textContent")
        before = page.evaluate("document.querySelector('#sphere svg').innerHTML")
        x, y = page.evaluate(
            "(() => { const n = document.querySelector('#sphere svg');"
            " n.scrollIntoView({block: 'center', behavior: 'instant'}); const b = n.getBoundingClientRect();"
            " return [b.x + b.width / 2, b.y + b.height / 2]; })()"
        )
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + 60, y + 20, steps=6)
        page.mouse.up()
        assert page.evaluate("document.querySelector('#sphere svg').innerHTML") != before
        page.evaluate(
            "(() => { const s = document.querySelector('#split'); s.value = 20;"
            " s.dispatchEvent(new Event('input')); })()"
        )
        assert page.evaluate("document.querySelector('.compare').style.getPropertyValue('--split')") == "20%"
        assert errors == []

        page.goto(f"{server.url}/static/viewer.html?w={trained}")
        wait_for(page, "document.querySelector('#picture')?.dataset.fine === 'yes'")
        first = page.evaluate("document.querySelector('#picture').toDataURL()")
        shown = int(page.evaluate("document.querySelector('#picture').dataset.frames"))
        x, y = page.evaluate(
            "(() => { const b = document.querySelector('#picture').getBoundingClientRect();"
            " return [b.x + b.width / 2, b.y + b.height / 2]; })()"
        )
        page.mouse.move(x, y)
        page.mouse.down()
        for step in range(1, 12):
            page.mouse.move(x + 12 * step, y + 3 * step)
            time.sleep(0.03)
        wait_for(page, f"Number(document.querySelector('#picture').dataset.frames) > {shown}")
        page.mouse.up()
        wait_for(page, "document.querySelector('#picture').dataset.fine === 'yes'")
        assert page.evaluate("document.querySelector('#picture').toDataURL()") != first
        assert "base image" in page.evaluate("document.querySelector('#times').textContent")
        page.evaluate("document.querySelector('#beside').click()")
        wait_for(page, "Number(document.querySelector('#reference').dataset.spp) >= 8")  # it gets better
        assert re.fullmatch(r"path-traced, \d+ samples a pixel, \d+ ms", page.inner_text("#reference-caption"))
        page.evaluate("document.querySelector('#beside').click()")
        assert page.evaluate("document.querySelector('#beside-stage').hidden")
        page.evaluate("document.querySelector('input[value=depth]').click()")
        wait_for(page, "document.querySelector('#picture').dataset.mode === 'depth'")
        assert errors == []


@needs_chromium
def test_what_changes_while_a_job_runs_in_a_browser(server: Server, trained: str) -> None:
    """The live picture comes and goes on by itself, with the reference beside it; seconds planned and spent."""
    workspace = server.root / "watched.dnr"
    shutil.copytree(server.root / f"{trained}.dnr", workspace, ignore=shutil.ignore_patterns("preview", ".lock*"))
    settings_default = prediction(2, 60)
    settings_default["choice"]["spp"] = 8
    write_plan(workspace, made=time.time(), chosen=None, settings_default=settings_default)
    settings: dict[str, Any] = {"finetune.step2.epochs": 60, "finetune.preview_seconds": 0.5}
    epoch = "Number(document.querySelector('#live').dataset.epoch)"
    with server.client() as client, open_page(server.url, width=1280) as (page, errors):
        job = client.submit(JobRequest(command="finetune", workspace="watched", settings=settings)).id
        wait_for(page, f"!!document.querySelector('#jobs tr[data-job=\"{job}\"]')")
        page.evaluate(f"document.querySelector('#jobs tr[data-job=\"{job}\"]').click()")
        wait_for(page, f"!document.querySelector('#live').hidden && {epoch}")
        first = page.evaluate(epoch)
        picture = page.evaluate("document.querySelector('#live-prediction').src")
        wait_for(page, f"{epoch} > {first}")
        assert page.evaluate("document.querySelector('#live-prediction').src") != picture
        assert page.evaluate("document.querySelector('#live-truth').naturalWidth") == 48
        assert " dB" in page.evaluate("document.querySelector('#live-caption').textContent")
        wait_for(page, "!document.querySelector('#plan').hidden")
        rows = page.evaluate(
            "[...document.querySelectorAll('#plan tbody tr')].map(r => [...r.children].map(c => c.textContent))"
        )
        assert [row[0] for row in rows] == ["select", "raytrace", "finetune", "until the renderer is there", "evaluate"]
        assert rows[1] == ["raytrace", "0:20", "done before"] and rows[3][1] == "1:00 (0:48 to 1:15)"
        assert "2 views, 8 spp, 60 epochs" in page.evaluate("document.querySelector('#plan caption').textContent")
        for _ in client.events(job):
            pass
        wait_for(page, f"{epoch} === 60")
        spent = "document.querySelector('#plan tbody tr:nth-child(3) td:nth-child(3)').textContent"
        wait_for(page, f"/^\\d+:\\d\\d$/.test({spent})")  # no longer "so far"
        assert errors == []


@needs_chromium
def test_a_page_without_the_token_asks_for_it(tmp_path: Path) -> None:
    token = "a-token-for-the-browser"
    file = tmp_path / "token"
    file.write_text(token)
    file.chmod(0o600)
    server = Server(tmp_path / "root", "--token-file", str(file))
    try:
        empty_workspace(server.root, "hidden")
        with open_page(server.url, width=1280) as (page, _):
            wait_for(page, "document.querySelector('#token-form')?.hidden === false")
            assert "hidden" not in page.evaluate("document.querySelector('#workspaces').textContent")
            page.evaluate(
                f"document.querySelector('#token').value = '{token}';"
                " document.querySelector('#token-form button').click()"
            )
            wait_for(page, "document.querySelector('#workspaces').textContent.includes('hidden')")
            assert token not in page.evaluate("location.href + document.body.innerHTML")
        assert token not in server.log.read_text()
    finally:
        server.stop()


@needs_chromium
def test_the_dashboard_by_keyboard(server: Server, trained: str) -> None:
    """Rows are buttons and keep the focus while the page refreshes; errors stay until they are dismissed."""
    empty_workspace(server.root, "keys")
    with server.client() as client, open_page(server.url, width=1280) as (page, errors):
        job = client.submit(JobRequest(command="finetune", workspace="keys")).id
        row = f"document.querySelector('#jobs tr[data-job=\"{job}\"]')"
        wait_for(page, f"{row}?.children[2].textContent === 'failed'")
        page.evaluate(f"{row}.querySelector('button').focus()")
        page.keyboard.press("Enter")
        wait_for(page, "!document.querySelector('#job').hidden")
        wait_for(page, "document.querySelector('#job-error').textContent.includes('prepare has not run')")
        page.wait_for_timeout(3500)  # a refresh later
        assert page.evaluate(f"document.activeElement === {row}.querySelector('button')")
        # Tried again: the pane goes on with the job by itself.
        page.keyboard.press("Tab")
        assert page.evaluate("document.activeElement.textContent") == "retry"
        page.keyboard.press("Enter")
        deadline = time.monotonic() + 60
        while sum(event.kind == "state" for event in client.events(job)) < 6:  # queued, running, failed; and again
            assert time.monotonic() < deadline
            time.sleep(0.1)
        wait_for(page, f"{row}.children[2].textContent === 'failed'")
        wait_for(page, "document.querySelector('#note').textContent.startsWith('failed')")
        assert page.evaluate("document.activeElement.textContent") == "retry"  # focus stayed where it was
        # A refused action says so in words, and the next refresh does not wipe it.
        page.evaluate(
            "document.querySelector('#workspace').append(new Option('a b', 'a b'));"
            " document.querySelector('#workspace').value = 'a b'; document.querySelector('#submit').requestSubmit()"
        )
        wait_for(page, "!document.querySelector('#problem').hidden")
        assert "a name has letters" in page.inner_text("#problem")
        page.wait_for_timeout(3500)
        assert page.evaluate("!document.querySelector('#problem').hidden")
        page.evaluate("document.querySelector('#dismiss').click()")
        assert page.evaluate("document.querySelector('#problem').hidden")
        page.evaluate(
            f"[...document.querySelectorAll('#workspaces button')].find(b => b.textContent === '{trained}').click()"
        )
        wait_for(page, f"document.querySelector('#detail-title').textContent === '{trained}'")
        spent = page.evaluate("[...document.querySelectorAll('#stages tbody tr')].map(r => r.children[3].textContent)")
        total = page.evaluate("document.querySelector('#cost').textContent").split()[3].rstrip(".")
        seconds = [
            60 * int(minutes) + int(rest)
            for minutes, _, rest in (text.partition(":") for text in (*spent, total) if text)
        ]
        assert abs(sum(seconds[:-1]) - seconds[-1]) <= len(seconds)  # each is rounded
        assert errors == [] or all("422" in error for error in errors)


@needs_chromium
def test_an_empty_server_says_what_to_do_and_its_viewer_gives_up(tmp_path: Path) -> None:
    token = "a-token-for-the-browser"
    file = tmp_path / "token"
    file.write_text(token)
    file.chmod(0o600)
    server = Server(tmp_path / "root", "--token-file", str(file))
    try:
        with open_page(f"{server.url}/static/viewer.html?w=none", width=400) as (page, _):
            wait_for(page, "document.querySelector('#token-form')?.hidden === false")
            page.fill("#token", token)
            page.press("#token", "Enter")
            wait_for(page, "!document.querySelector('#again').hidden")
            assert "no such workspace" in page.inner_text("#problem")
            asked = server.log.read_text().count("/workspaces/none")
            page.wait_for_timeout(4000)
            assert server.log.read_text().count("/workspaces/none") == asked  # not again by itself
            page.goto(server.url)
            wait_for(page, "document.querySelector('#no-jobs')?.hidden === false")
            assert "Choose a scene file" in page.inner_text("#no-jobs")
            assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
    finally:
        server.stop()


@needs_chromium
def test_a_tour_by_keyboard_alone(server: Server, trained: str) -> None:
    """From the search to a job, a workspace, its deletion (refused), the viewer, another camera and another mode."""

    def tab_to(what: str) -> None:
        for _ in range(80):
            page.keyboard.press("Tab")
            if page.evaluate(f"document.activeElement.matches({what!r})"):
                return
        raise AssertionError(f"Tab never comes to {what}")

    def picture() -> str:
        return page.evaluate("document.querySelector('#picture').toDataURL()")

    with open_page(server.url, width=1280) as (page, errors):
        wait_for(page, "document.querySelectorAll('#jobs tbody tr').length > 0")
        tab_to("#search")
        page.keyboard.type(f"run {trained}")
        wait_for(page, "document.querySelectorAll('#jobs tbody tr').length === 1")
        tab_to("#jobs button.link")
        page.keyboard.press("Enter")
        wait_for(page, f"document.querySelector('#job-title').textContent.endsWith('run {trained}')")
        wait_for(page, f"document.querySelector('#workspaces li[data-key={trained}]') !== null")
        tab_to(f"#workspaces li[data-key={trained}] button")
        page.keyboard.press("Enter")
        wait_for(page, f"document.querySelector('#detail-title').textContent === '{trained}'")
        tab_to("#delete")
        page.keyboard.press("Enter")
        assert page.evaluate("document.activeElement.id") == "sure-no"
        page.keyboard.press("Enter")
        assert page.evaluate("document.activeElement.id") == "delete"
        page.keyboard.press("Shift+Tab")
        page.keyboard.press("Shift+Tab")
        assert page.evaluate("document.activeElement.id") == "open-viewer"
        with page.expect_navigation():
            page.keyboard.press("Enter")
        wait_for(page, "document.querySelector('#picture')?.dataset.fine === 'yes'")
        tab_to("#picture")
        before, frames = picture(), int(page.evaluate("document.querySelector('#picture').dataset.frames"))
        for _ in range(5):
            page.keyboard.press("ArrowLeft")
        wait_for(page, f"Number(document.querySelector('#picture').dataset.frames) > {frames}")
        wait_for(page, "document.querySelector('#picture').dataset.fine === 'yes'")
        assert picture() != before
        tab_to("#modes input")
        page.keyboard.press("ArrowDown")
        wait_for(page, "document.querySelector('#picture').dataset.mode === 'base'")
        assert errors == []


@needs_chromium
@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "dark")])
def test_no_serious_violation_of_accessibility(
    server: Server, trained: str, width: int, scheme: Literal["light", "dark"]
) -> None:
    """By axe-core, on what its rules for WCAG 2 A and AA see: dashboard with a job and a workspace open, viewer."""
    name = f"wcag-{width}"
    empty_workspace(server.root, name)
    with server.client() as client, open_page(server.url, width=width, color_scheme=scheme) as (page, _):
        job = client.submit(JobRequest(command="finetune", workspace=name)).id
        row = f"document.querySelector('#jobs tr[data-job=\"{job}\"]')"
        wait_for(page, f"{row}?.children[2].textContent === 'failed'")
        page.evaluate(f"{row}.querySelector('button').click()")
        page.evaluate(
            f"[...document.querySelectorAll('#workspaces button')].find(b => b.textContent === '{trained}').click()"
        )
        wait_for(page, f"document.querySelector('#detail-title').textContent === '{trained}'")
        wait_for(page, "document.querySelector('#job-error').textContent !== ''")
        assert _violations(page) == []
        page.goto(f"{server.url}/static/viewer.html?w={trained}")
        wait_for(page, "document.querySelectorAll('#times tr').length > 2")
        assert _violations(page) == []
        assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")


@needs_chromium
def test_the_workspace_chosen_last_is_shown(server: Server, trained: str) -> None:
    """Also where the server answers for another one later."""
    empty_workspace(server.root, "slow")
    chosen = "[...document.querySelectorAll('#workspaces button')].find(b => b.textContent === '{}')"
    title = "document.querySelector('#detail-title').textContent"
    held: list[Route] = []
    with open_page(server.url, width=1280) as (page, errors):
        page.route("**/workspaces/slow", lambda route: held.append(route))
        wait_for(page, f"!!{chosen.format('slow')}")
        page.evaluate(f"{chosen.format('slow')}.click()")
        page.evaluate(f"{chosen.format(trained)}.click()")
        wait_for(page, f"{title} === '{trained}' && document.querySelector('#truth').naturalWidth > 0")
        with page.expect_response("**/workspaces/slow"):
            held[0].continue_()
        page.wait_for_timeout(300)
        assert page.evaluate(title) == trained
        assert errors == []


def _violations(page: Page) -> list[str]:
    """What axe-core calls serious or critical: rule, where."""
    found = Axe().run(page, options={"runOnly": ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "best-practice"]})
    return [
        f"{violation['id']}: {node['html'][:100]} {node['failureSummary']}"
        for violation in found.response["violations"]
        if violation["impact"] in ("serious", "critical")
        for node in violation["nodes"]
    ]
