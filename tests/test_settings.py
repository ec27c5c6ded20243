"""Layers, presets and refusals of the settings."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dnrpipe.core.errors import UserError
from dnrpipe.core.settings import PRESETS, merge, parse_assignment, resolve
from dnrpipe.core.workspace import Source, Workspace
from dnrpipe.stages.pipeline import STAGES
from dnrpipe.stages.session import Session, resolve_settings


def test_layers_win_in_order(tmp_path: Path) -> None:
    toml = tmp_path / "dnrpipe.toml"
    toml.write_text("[cameras]\ntrain = 50\nval = 6\ntest = 7\n")
    environment = {"DNRPIPE_CAMERAS__VAL": "8", "DNRPIPE_CAMERAS__TEST": "9"}
    settings = resolve(None, {"cameras": {"test": 10}}, toml_files=[toml], environment=environment)
    assert settings.preset == "draft"
    assert settings.cameras.width == PRESETS["draft"]["cameras"]["width"]
    assert (settings.cameras.train, settings.cameras.val, settings.cameras.test) == (50, 8, 10)


@pytest.mark.parametrize(
    ("model", "advice"),
    [
        ({"base": "none"}, ["output = log", "base = none", "--set model.output=display", "--set model.base=baked"]),
        ({"base": "none", "output": "display"}, ["filter = 3", "base = none", "--set model.filter=0"]),
        ({"base": "raster", "chain": True}, ["chain = true", "base = raster", "--set model.chain=false"]),
        ({"base": "raster", "guides": "camera"}, ["guides = camera", "--set model.guides=true"]),
        (
            {"aggregator": "none", "base": "none", "output": "display", "filter": 0, "guides": True},
            ["aggregator = none"],
        ),
        ({"width": 32}, ["start = pretrained", "width = 24", "--set model.width=24", "start=fresh"]),
        ({"chain": True, "aggregator": "early"}, ["chain = true", "aggregator = early", "--set model.aggregator="]),
    ],
)
def test_a_conflict_names_both_settings_and_what_to_type(model: dict[str, object], advice: list[str]) -> None:
    with pytest.raises(UserError) as raised:
        resolve("draft", {"model": model}, environment={})
    message = str(raised.value)
    assert message.startswith("setting ") and "{" not in message and "\n" not in message
    for words in advice:
        assert words in message


def test_paper_preset_has_the_papers_numbers() -> None:
    s = resolve("paper", {}, environment={})
    assert (s.cameras.train, s.cameras.val, s.cameras.test) == (100, 100, 200)
    assert (s.cameras.width, s.cameras.height) == (800, 800)
    assert (s.select.step1.epochs, s.finetune.step2.epochs) == (50, 100)
    assert (s.select.step1.weight_rl, s.select.step1.weight_dnr) == (0.1, 1.0)
    w = s.finetune.step2.loss
    assert (w.photometric, w.ssim, w.perceptual, w.frequency, w.total_variation, w.regularisation) == (
        1.0,
        0.1,
        0.1,
        0.01,
        0.001,
        0.1,
    )
    for step in (s.select.step1, s.finetune.step2):
        assert (step.learning_rate, step.learning_rate_end) == (1e-3, 1e-4)
    assert s.model.aggregator == "concat"
    assert s.finetune.step2.augment


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_validates(preset: str) -> None:
    assert resolve(preset, {}, environment={}).preset == preset


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({"camera": {}}, ["unknown setting 'camera'", "cameras"]),
        ({"cameras": {"trian": 3}}, ["cameras.trian", "cameras.train"]),
        ({"select": {"budget": -1}}, ["select.budget", "-1"]),
        ({"cameras": {"train": "many"}}, ["cameras.train", "many"]),
        ({"cameras": 3}, ["cameras"]),
        ({"device": "tpu"}, ["device"]),
    ],
)
def test_bad_settings_are_named(overrides: dict, words: list[str]) -> None:
    with pytest.raises(UserError) as caught:
        resolve(None, overrides, environment={})
    assert "\n" not in str(caught.value)
    for word in words:
        assert word in str(caught.value)


def test_unknown_environment_and_preset_and_broken_toml(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="environment: unknown setting"):
        resolve(None, {}, environment={"DNRPIPE_CAMERAS__TRIAN": "3"})
    with pytest.raises(UserError, match="unknown preset 'fast'"):
        resolve("fast", {}, environment={})
    toml = tmp_path / "dnrpipe.toml"
    toml.write_text("[cameras\n")
    with pytest.raises(UserError, match="not valid TOML"):
        resolve(None, {}, toml_files=[toml], environment={})


def test_a_layer_names_the_preset_and_its_mistakes(tmp_path: Path) -> None:
    toml = tmp_path / "dnrpipe.toml"
    toml.write_text('preset = "standard"\n')
    environment = {"DNRPIPE_PRESET": "paper", "DNRPIPE_WORKSPACE": "elsewhere", "DNRPIPE_EFFECTS__ENABLE": "['glow']"}
    assert resolve(None, {}, toml_files=[toml], environment={}).preset == "standard"
    settings = resolve(None, {}, toml_files=[toml], environment=environment)
    assert settings.preset == "paper" and settings.effects.enable == ("glow",)
    assert resolve("vanilla", {}, toml_files=[toml], environment=environment).preset == "vanilla"
    assert resolve(None, {}, environment={"DNRPIPE_PRESET": ""}).preset == "draft"
    with pytest.raises(UserError, match="unknown preset '3'"):
        resolve(None, {"preset": 3}, environment={})
    with pytest.raises(UserError, match=r"environment: unknown setting 'camera'; did you mean 'cameras'\?"):
        resolve(None, {}, environment={"DNRPIPE_CAMERA__TRAIN": "3"})
    with pytest.raises(UserError, match="flags: setting 'device' is a single value, not a table"):
        resolve(None, {"device": {"name": "cpu"}}, environment={})
    toml.write_text("[cameras]\ntrian = 3\n")
    with pytest.raises(UserError, match=rf"{toml}: unknown setting 'cameras.trian'; did you mean 'cameras.train'\?"):
        resolve(None, {}, toml_files=[toml], environment={})


def test_assignments() -> None:
    assert parse_assignment("a.b=3") == {"a": {"b": 3}}
    assert parse_assignment("a=true") == {"a": True}
    assert parse_assignment("a=hello") == {"a": "hello"}
    with pytest.raises(UserError, match="KEY=VALUE"):
        parse_assignment("a.b")


_nested = st.recursive(
    st.integers(), lambda children: st.dictionaries(st.sampled_from("abc"), children, max_size=3), max_leaves=6
)


@given(st.dictionaries(st.sampled_from("abc"), _nested), st.dictionaries(st.sampled_from("abc"), _nested))
def test_merge_leaves_its_arguments_alone_and_the_later_wins(base: dict, extra: dict) -> None:
    import copy

    before = copy.deepcopy((base, extra))
    merged = merge(base, extra)
    assert (base, extra) == before
    for key, value in extra.items():
        if not isinstance(value, dict):
            assert merged[key] == value
    assert merge(merged, extra) == merged


def test_targets_of_tracing_are_one_wish() -> None:
    """Flags forget what others said before; with a target, --spp is its limit; settings read the same amounts."""
    from dnrpipe.cli.options import tracing_overrides

    both = tracing_overrides("1%", "10m", 4096, None)
    assert both == {"raytrace": {"noise": 0.01, "time": 600.0, "max_spp": 4096}}
    assert tracing_overrides("1%", None, None, None)["raytrace"] == {"noise": 0.01, "time": None}
    assert tracing_overrides(None, None, 64, None)["raytrace"] == {"spp": 64, "noise": None, "time": None}
    assert tracing_overrides(None, None, None, "none") == {"raytrace": {"denoise": False}}
    assert tracing_overrides(None, None, None, None) == {}
    settings = resolve(
        "draft", {"raytrace": {"noise": "1%", "time": "1m30s", "evaluation_noise": 0.02}}, environment={}
    )
    assert (settings.raytrace.noise, settings.raytrace.time, settings.raytrace.evaluation_noise) == (0.01, 90.0, 0.02)


@pytest.mark.parametrize(
    ("noise", "time", "spp", "words"),
    [
        ("0", None, None, "--noise 0: expected a share"),
        ("150%", None, None, "--noise 150%: expected a share"),
        (None, "soon", None, "--time soon: expected a time above 0, e.g. 90s"),
        ("1%", None, 4, "--spp 4: with --noise or --time at least 8"),
        (None, None, 0, "--spp 0: must be at least 1"),
    ],
)
def test_bad_targets_are_named(noise: str | None, time: str | None, spp: int | None, words: str) -> None:
    from dnrpipe.cli.options import tracing_overrides

    with pytest.raises(UserError) as caught:
        tracing_overrides(noise, time, spp, None)
    assert words in str(caught.value)


def test_a_target_of_tracing_changes_no_fingerprint_where_there_is_none() -> None:
    """Workspaces made before there were targets stay done; with one, the plain count no longer matters."""
    from dnrpipe.stages.pipeline import STAGES

    def tracing(**changes: object) -> list[object]:
        settings = resolve("draft", {"raytrace": changes}, environment={})
        return [STAGES[name].settings(settings)[0] for name in ("raytrace", "evaluate")]

    plain = tracing()
    assert plain[0] == {"spp": 128, "max_depth": "auto", "denoise": True, "seed": 0}
    assert plain[1] == {
        "evaluation_spp": 512,
        "max_depth": "auto",
        "evaluation_denoise": True,
        "evaluation_baseline": True,
        "seed": 0,
    }
    assert tracing(max_spp=100) == plain
    assert tracing(noise=0.01) == tracing(noise=0.01, spp=7)
    assert tracing(noise=0.01)[0] != tracing(noise=0.02)[0]
    assert tracing(noise=0.01)[1] == plain[1]
    assert tracing(evaluation_noise=0.01)[0] == plain[0]


def test_a_camera_file_counts_by_its_content_whoever_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An edited file is noticed without --cameras, too; one that is gone is remembered."""
    monkeypatch.chdir(tmp_path)
    workspace = Workspace.create(tmp_path / "w.dnr", Source(path="s.blend", sha256="0"))
    views = tmp_path / "views.json"
    views.write_text("first")
    (tmp_path / "dnrpipe.toml").write_text('[cameras]\nsource = "views.json"\n')

    def inputs(**cameras: str) -> object:
        overrides = {"cameras": cameras} if cameras else {}
        return STAGES["prepare"].settings(resolve_settings(Workspace.open(workspace.root), overrides, None))

    options = {"workspace": str(workspace.root), "preset": None, "assignments": (), "as_json": False, "quiet": True}
    with Session("finetune", options, None, {}) as session:
        first = STAGES["prepare"].settings(session.settings)
        session.workspace.save()
    assert inputs() == first
    views.write_text("second")
    assert inputs() != first
    views.unlink()
    assert inputs() == first
    assert inputs(source="elsewhere.json") != first
    assert inputs(source="dome") != first
    (tmp_path / "moved.json").write_text("first")
    assert inputs(source="moved.json") == first
