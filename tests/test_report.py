"""The report: right figures, safe and self-contained HTML, and a page that a browser really draws."""

from __future__ import annotations

import json
import re
import statistics
import subprocess
import sys
from datetime import UTC, datetime
from html.parser import HTMLParser
from importlib import util
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from PIL import Image

from dnrpipe.core.errors import UserError
from dnrpipe.core.units import duration, several
from dnrpipe.export.browser import find_chromium, open_page
from dnrpipe.report import build_report, charts
from dnrpipe.report.collect import collect
from dnrpipe.report.pictures import load_png
from dnrpipe.report.render import render_html

WHEN = datetime(2026, 1, 2, 3, 4, tzinfo=UTC)


def _neighbour(name: str) -> ModuleType:
    """A helper module beside this one: importlib mode keeps the tests folder off sys.path."""
    spec = util.spec_from_file_location(name, Path(__file__).with_name(f"{name}.py"))
    assert spec is not None and spec.loader is not None
    module = util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


make_workspace = _neighbour("report_workspace").make_workspace
needs_browser = pytest.mark.skipif(find_chromium() is None, reason="no Chromium is installed")


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_workspace(tmp_path_factory.mktemp("report") / "toy room.dnr")


@pytest.fixture(scope="module")
def page(workspace: Path) -> str:
    return build_report(workspace, made_at=WHEN).read_text(encoding="utf-8")


class _Loads(HTMLParser):
    """Collects whatever would make a browser load something, and the visible text."""

    def __init__(self) -> None:
        super().__init__()
        self.urls: list[str] = []
        self.tags: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        names = {"src", "srcset", "href", "xlink:href", "data", "action", "poster", "background"}
        self.urls += [value or "" for name, value in attrs if name in names]

    def handle_data(self, data: str) -> None:
        self.text += data


def _parse(html: str) -> _Loads:
    parser = _Loads()
    parser.feed(html)
    return parser


def _rewrite(path: Path, change: Any) -> None:
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def test_nothing_is_loaded_from_elsewhere(page: str) -> None:
    parsed = _parse(page)
    assert all(url.startswith(("data:image/", "#")) for url in parsed.urls), [u[:60] for u in parsed.urls]
    assert any(url.startswith("data:image/png") for url in parsed.urls)
    assert not {"link", "iframe", "object", "embed", "base"} & set(parsed.tags)
    assert "@import" not in page and re.search(r"url\((?!#)", page) is None
    assert re.search(r"https?://", page) is None


def test_figures_agree_with_the_files(workspace: Path, page: str) -> None:
    data = collect(workspace).model_dump(mode="json")
    metrics = json.loads((workspace / "evaluation" / "metrics.json").read_text())
    values = {v["name"]: v["psnr"] for v in metrics["views"]}
    row = next(r for r in data["quality"]["rows"] if r["key"] == "psnr")
    assert row["mean"] == pytest.approx(metrics["mean"]["psnr"])
    assert row["median"] == pytest.approx(statistics.median(values.values()))
    assert (row["worst"], row["worst_view"]) == (min(values.values()), min(values, key=lambda k: values[k]))
    lpips = next(r for r in data["quality"]["rows"] if r["key"] == "lpips_vgg")
    assert lpips["worst"] == max(v["lpips_vgg"] for v in metrics["views"])  # lower is better
    assert [v["psnr"] for v in data["quality"]["views"]] == sorted(values.values())
    assert data["quality"]["median_view"] == sorted(values, key=lambda k: values[k])[3]  # of seven
    # 4 views at 4.0, 4.7, 5.4, 6.1 s on 2 workers; 16 candidates; step 1 took 12 × 2 s.
    tracing = data["costs"]["tracing_all"]
    assert tracing["actual_seconds"] == pytest.approx(10.1)
    assert tracing["all_seconds"] == pytest.approx(40.4)
    assert tracing["net_saved_seconds"] == pytest.approx(40.4 - 10.1 - 24)
    assert data["upfront_seconds"] == pytest.approx(6.4 + 18 * 0.03 + 24 + 10.1 + 60)
    # A frame: 13.1 ms and 30 ms of passes, against 8.2 s on 2 workers.
    assert data["quality"]["frame_seconds"] == pytest.approx(0.0431)
    assert data["break_even"] == int(np.ceil(data["upfront_seconds"] / (4.1 - 0.0431)))
    for text in (f"{row['mean']:.2f}", "4 of 16", "10.1 s", "40.4 s", "13 ms", "4.10 s", "spread 90°"):
        assert text in page, text
    assert json.loads((workspace / "report" / "report.json").read_text()) == {**data, "made_at": "2026-01-02 03:04 UTC"}
    assert "/home/someone" not in page  # a report is passed on; the artist's folders are not


def test_reward_and_action_value_are_no_losses(workspace: Path, page: str) -> None:
    first = collect(workspace).model_dump(mode="json")["training"][0]
    assert list(first["losses"]) == ["dnr", "rl"]
    assert list(first["agent"]) == ["reward", "q"] and first["agent"]["q"][0][1] < 0
    assert "Reward and action value of the view selector" in page


def test_same_input_same_bytes(workspace: Path, page: str) -> None:
    code = (
        "import sys; from datetime import datetime, UTC; from pathlib import Path\n"
        "from dnrpipe.report.collect import collect; from dnrpipe.report.render import render_html\n"
        "sys.stdout.buffer.write(render_html(collect(Path(sys.argv[1]),"
        " made_at=datetime(2026, 1, 2, 3, 4, tzinfo=UTC))).encode())"
    )
    again = subprocess.run(
        [sys.executable, "-c", code, str(workspace)],
        capture_output=True,
        check=True,
        env={"PYTHONHASHSEED": "123", "PATH": "/usr/bin:/bin"},
    )
    assert again.stdout.decode() == page


def test_names_from_the_scene_cannot_inject(tmp_path: Path) -> None:
    hostile = '"><script>alert(1)</script><img src=x onerror=alert(2)>&lt;b&gt;{{ 7*7 }}'
    root = make_workspace(tmp_path / "x.dnr", tests=1, candidates=12, size=16, hostile=hostile)
    for step in (1, 2):  # loss terms go into an SVG
        _rewrite(
            root / "checkpoints" / f"step{step}" / "model.json",
            lambda d: [h["losses"].update({hostile: 0.5}) for h in d["history"]],
        )
    html = build_report(root).read_text(encoding="utf-8")
    parsed = _parse(html)
    assert parsed.tags.count("script") == 1
    assert all(url.startswith(("data:image/", "#")) for url in parsed.urls)
    assert "onerror=alert(2)>&lt;b" in parsed.text  # shown as it is, as text
    assert "49" not in re.findall(r"Velvet[^<]*", html)[0]


def test_the_script_is_the_one_the_policy_allows(page: str) -> None:
    import base64
    import hashlib

    script = re.search(r"<script>(.*?)</script>", page, re.S)
    allowed = re.search(r"script-src 'sha256-([^']+)'", page)
    assert script is not None and allowed is not None
    assert base64.b64encode(hashlib.sha256(script[1].encode()).digest()).decode() == allowed[1]


def test_every_half_done_workspace_has_a_report(tmp_path: Path) -> None:
    root = make_workspace(tmp_path / "half way.dnr", size=16)
    expected = [
        ("evaluation/metrics.json", "dnrpipe evaluate -w 'half way.dnr'"),
        ("checkpoints/step2/model.json", "dnrpipe finetune -w"),
        ("raytraced/train/0004.exr", "dnrpipe raytrace-selected -w"),
        ("selection.json", "dnrpipe select -w"),
        ("scene/census.json", None),
        ("scene/summary.json", None),
        ("scene/frame.json", None),
        ("costs.jsonl", None),
        ("cameras/train.json", "dnrpipe prepare SCENE -w"),
    ]
    commands: list[str] = []
    for file, command in expected:
        (root / file).unlink()
        commands += [command] if command else []
        html = build_report(root).read_text(encoding="utf-8").replace("&#39;", "'")
        if "raytraced" in file:
            assert "Only 3 of the 4 chosen views are ray-traced so far." in html
        if file == "checkpoints/step2/model.json":
            assert "it is not trained yet" in html
        for each in commands:
            assert each in html, (file, each)
    (root / "manifest.json").unlink()
    with pytest.raises(UserError, match="not a dnrpipe workspace"):
        build_report(root)


BAD_EPOCH = json.dumps(
    {"model": {}, "fingerprint": "f", "run": "r", "stage": "step1", "settings": {}, "seed": 0, "bfloat16": False}
    | {"history": [{"epoch": "x"}]}
)


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("evaluation/metrics.json", '{"views": [', r"metrics\.json: damaged \(Invalid JSON.*dnrpipe evaluate"),
        ("evaluation/metrics.json", '{"views": []}', r"metrics\.json: damaged \(views: .*dnrpipe evaluate"),
        ("evaluation/metrics.json", '{"views": [{"name": "../../etc/x"}]}', r"views\.0\.name"),
        ("selection.json", "[]", r"selection\.json: damaged \(Input should be an object.*dnrpipe select"),
        ("checkpoints/step1/model.json", BAD_EPOCH, r"history\.0\.epoch"),
        ("cameras/test.json", '{"frames": [{}]}', r"test\.json: damaged \(frame 0"),
        ("evaluation/0003.truth.png", "not a picture", r"0003\.truth\.png: damaged image"),
        ("raytraced/train/0011.exr", "not an exr", r"0011\.exr: damaged \(EXR"),
        ("costs.jsonl", '{"a": 1}\n', r"costs\.jsonl:1: not a cost record"),
    ],
)
def test_damaged_files_are_named(tmp_path: Path, file: str, text: str, message: str) -> None:
    root = make_workspace(tmp_path / "x.dnr", size=16)
    (root / file).write_text(text)
    with pytest.raises(UserError, match=message):
        build_report(root)


def test_missing_weights_and_noisy_references_are_said(tmp_path: Path) -> None:
    root = make_workspace(tmp_path / "x.dnr", size=16, lpips=False)

    def noisy(metrics: dict[str, Any]) -> None:
        for view in metrics["views"]:
            view["ceiling_psnr"] = view["psnr"] + 1.0

    _rewrite(root / "evaluation" / "metrics.json", noisy)
    html = build_report(root).read_text(encoding="utf-8")
    assert "L_p was dropped" in html and "LPIPS could not be measured" in html
    assert "That noise makes up 79 %" in html  # 10^(-0.1)
    assert "at least half of it in 7 of 7 views" in html
    for metrics_has in (True, False):  # weights came later, or L_p was switched off: nothing was dropped
        _rewrite(
            root / "evaluation" / "metrics.json",
            lambda m, has=metrics_has: m.update(trained_with_perceptual=has),
        )
        if not metrics_has:
            _rewrite(
                root / "manifest.json",
                lambda m: m["settings"]["finetune"]["step2"]["loss"].update(perceptual=0.0),
            )
        assert "L_p was dropped" not in build_report(root).read_text(encoding="utf-8")


def test_a_renderer_without_training_is_said_to_be_that(tmp_path: Path) -> None:
    """`--budget 0`: the shipped corrector is the model of step 2, with no history and no views."""
    root = make_workspace(tmp_path / "x.dnr", size=16, chosen=[], lpips=False)
    _rewrite(root / "checkpoints" / "step2" / "model.json", lambda m: m.update(history=[]))
    data = collect(root)
    assert data.verdict.startswith("Without training, the renderer reaches")
    assert not any("finetune" in part.command for part in data.missing)
    told = " ".join(data.notes)
    assert "LPIPS could not be measured" in told and "L_p was dropped" not in told
    (root / "evaluation" / "metrics.json").unlink()
    assert "it has not been measured yet" in collect(root).verdict


def test_choosing_that_costs_more_than_it_saves_is_said(tmp_path: Path) -> None:
    root = make_workspace(tmp_path / "x.dnr", candidates=12, size=16)  # saves 20.2 s, step 1 takes 24 s
    html = build_report(root).read_text(encoding="utf-8")
    assert "tracing every candidate costs less than choosing" in html
    assert "−3.80 s" in html


def test_a_perfect_and_a_broken_view(tmp_path: Path) -> None:
    root = make_workspace(tmp_path / "x.dnr", size=16)

    def change(metrics: dict[str, Any]) -> None:
        metrics["views"][0].update(psnr=None, ssim=1.0, psnr_mask=None)
        metrics["views"][1].update(psnr=None, ssim=None, psnr_mask=None)

    _rewrite(root / "evaluation" / "metrics.json", change)
    data = collect(root)
    assert data.quality is not None
    assert (data.quality.views[0].name, data.quality.views[-1].name) == ("0001", "0000")
    assert next(r for r in data.quality.rows if r.key == "psnr").count == 5
    assert "PSNR is not finite in 2 of 7 views" in render_html(data)


@pytest.mark.parametrize("tests", [1, 2])
def test_few_test_views_are_shown_once(tmp_path: Path, tests: int) -> None:
    root = make_workspace(tmp_path / "x.dnr", tests=tests, size=16)
    html = build_report(root).read_text(encoding="utf-8")
    titles = re.findall(r"<h3>((?:Worst|Median|Best)[^<]*)</h3>", html)
    assert len(titles) == tests
    assert "The other" not in html


def test_large_pictures_are_reduced_and_grey_error_maps_coloured(tmp_path: Path) -> None:
    Image.new("RGB", (900, 450), (200, 10, 10)).save(tmp_path / "big.png")
    big = load_png(tmp_path, "big.png", side=300)
    assert big is not None and (big.width, big.height) == (300, 150) and "image/webp" in big.uri
    small = load_png(tmp_path, "big.png", side=900)
    assert small is not None and "image/png" in small.uri
    import base64
    import io

    Image.new("L", (4, 4), 255).save(tmp_path / "flip.png")
    heat = load_png(tmp_path, "flip.png", side=9, heat=True)
    assert heat is not None
    pixel = Image.open(io.BytesIO(base64.b64decode(heat.uri.split(",")[1]))).convert("RGB").getpixel((0, 0))
    assert pixel == (252, 253, 191)  # the bright end of magma
    assert load_png(tmp_path, "none.png", side=9) is None


def test_thumbnails_go_through_the_display_transform(workspace: Path) -> None:
    from dnrpipe.report.pictures import load_exr
    from dnrtrain.contract import SceneFrame
    from dnrtrain.display import DisplayTransform

    frame = SceneFrame.model_validate_json((workspace / "scene" / "frame.json").read_text())

    def mean(exposure: float) -> float:
        import base64
        import io

        display = DisplayTransform(frame.model_copy(update={"exposure": exposure}), workspace / "scene")
        picture = load_exr(workspace, "raytraced/train/0004.exr", display)
        assert picture is not None
        image = np.asarray(Image.open(io.BytesIO(base64.b64decode(picture.uri.split(",")[1]))).convert("RGB"))
        assert (image[0, 0] == 255).all()  # background: white
        return float(image.mean())

    assert mean(1.0) > mean(0.0) + 3


@pytest.mark.parametrize(
    ("low", "high"), [(0.0, 1.0), (23.4, 31.9), (-5.0, 5.0), (0.0013, 0.0014), (7.0, 7.0), (0.0, 0.0), (1e5, 9e5)]
)
def test_linear_ticks_are_few_even_and_enclose(low: float, high: float) -> None:
    ticks = charts.linear_ticks(low, high)
    steps = np.diff(ticks)
    assert ticks[0] <= low + 1e-9 and ticks[-1] >= high - 1e-9
    assert 2 <= len(ticks) <= 12
    assert np.allclose(steps, steps[0])


@pytest.mark.parametrize(("low", "high"), [(0.002, 3.0), (1.0, 1.0), (0.4, 0.6), (1e-9, 10.0), (3.0, 4.0)])
def test_log_ticks_enclose(low: float, high: float) -> None:
    ticks = charts.log_ticks(low, high)
    assert ticks[0] <= low * 1.001 and len(ticks) >= 2 and ticks == sorted(ticks) and len(ticks) <= 10


def test_labels_are_spread_and_kept_inside() -> None:
    spread = charts.spread([100.0, 101.0, 99.0, 200.0], 10.0, 200.0)
    assert min(np.diff(sorted(spread))) >= 13.9
    assert max(spread) <= 200.0
    assert np.argsort(spread).tolist() == [2, 0, 1, 3]


def test_charts_survive_degenerate_series() -> None:
    assert charts.line_chart([], "t", "x", "y") == ""
    assert charts.line_chart([charts.Series("a", [(1, 0.0), (2, -1.0)])], "t", "x", "y", log=True) == ""
    for points in ([(1, 2.0)], [(1, 2.0), (2, 2.0)], [(1, float("nan")), (2, 3.0)]):
        for log in (False, True):
            drawn = charts.line_chart([charts.Series("a", points)], "t", "x", "y", log=log)
            assert "polyline" in drawn and "nan" not in drawn and "inf" not in drawn
    assert charts.bar_chart([charts.Bar("a", [], "0 s")], "t") == ""


def test_projections_are_right_handed() -> None:
    for projection in ("top", "front", "oblique"):
        axes = np.array([charts.project(tuple(row), projection) for row in np.eye(3).tolist()])  # type: ignore[arg-type]
        assert np.allclose(axes @ axes.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(axes) == pytest.approx(1.0)
    assert charts.project((0.0, -1.0, 0.0), "front")[2] == 1.0  # the front of a Blender scene looks along -Y


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.0, "0 s"), (0.0131, "13 ms"), (0.00042, "0.42 ms"), (0.9999, "1.00 s"), (2.414, "2.41 s"),
        (48.26, "48.3 s"), (99.96, "1 min 40 s"), (185.0, "3 min 05 s"), (7800.0, "2 h 10 min"), (-12.0, "−12.0 s"),
    ],
)  # fmt: skip
def test_durations(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def test_sample_counts_in_words() -> None:
    assert several([64]) == "64"
    assert several([32, 64, 128]) == "32, 64, 128"
    assert several([80, 112, 160, 664]) == "80 to 664"


@needs_browser
@pytest.mark.slow
@pytest.mark.parametrize(("width", "dark"), [(1280, False), (1280, True), (375, False)])
def test_a_browser_draws_it(workspace: Path, page: str, tmp_path: Path, width: int, dark: bool) -> None:
    picture = tmp_path / "page.png"
    address = (workspace / "report" / "report.html").as_uri()
    scheme = "dark" if dark else "light"
    with open_page(address, width=width, height=1400, color_scheme=scheme) as (drawn, errors):
        drawn.screenshot(path=picture)
    assert errors == []
    pixels = np.asarray(Image.open(picture).convert("RGB")).astype(int)
    assert pixels.shape == (1400, width, 3)
    assert pixels.std() > 15
    corner = pixels[2, 2].mean()
    assert corner < 60 if dark else corner > 220
    # Nothing runs off the side: the outermost columns show the page's background only.
    assert np.ptp(pixels[:, width - 6 :].reshape(-1, 3), axis=0).max() == 0
    colourful = np.ptp(pixels, axis=2) > 60  # the ball of the hero picture
    assert colourful[150:1100].mean() > 0.02


@needs_browser
@pytest.mark.slow
def test_the_dom_holds_the_figures_and_the_script_ran(workspace: Path, page: str) -> None:
    with open_page((workspace / "report" / "report.html").as_uri()) as (drawn, _):
        dom = drawn.content()
    data = collect(workspace).model_dump(mode="json")
    text = " ".join(_parse(dom).text.split())
    mean = next(r for r in data["quality"]["rows"] if r["key"] == "psnr")["mean"]
    assert f"PSNR, held-out{mean:.2f} dB" in text
    assert "Views ray-traced4 of 16" in text
    assert "Tracing the training views10.1 s" in text
    assert re.search(r'<html[^>]*class="js"', dom)  # the policy let our script run


@needs_browser
@pytest.mark.slow
def test_a_hostile_name_runs_nothing_in_a_browser(tmp_path: Path) -> None:
    hostile = "\"><script>document.title='owned'</script><img src=x onerror=\"document.title='owned'\">"
    root = make_workspace(tmp_path / "x.dnr", tests=1, candidates=12, size=16, hostile=hostile)
    with open_page(build_report(root).as_uri()) as (drawn, _):
        assert "dnrpipe report" in drawn.title()
