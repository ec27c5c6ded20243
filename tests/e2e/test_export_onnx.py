"""`dnrpipe export-onnx` on a finished workspace."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from e2e_harness import image, run

from dnrpipe.cli import _main

pytestmark = [pytest.mark.slow, pytest.mark.e2e]
pytest.importorskip("onnxruntime")


def test_the_file_renders_what_evaluate_rendered(tiny: Path, tmp_path: Path) -> None:
    """From the EXR files to evaluation's own PNG, without torch (which evaluated in bfloat16 where that is fast)."""
    import onnxruntime

    from dnrpipe.core.scene_files import split_views
    from dnrpipe.core.workspace import Workspace
    from dnrpipe.export.onnx import view_inputs

    out = tmp_path / "m.onnx"
    answer = json.loads(run("export-onnx", str(tiny), "--out", str(out), "--json", folder=tmp_path).stdout)
    assert answer["largest_difference"] < 1e-4 and len(answer["views"]) == 2
    session = onnxruntime.InferenceSession(str(out), providers=["CPUExecutionProvider"])
    workspace = Workspace.open(tiny)
    for view in split_views(workspace)["test"]:
        inputs = view_inputs(workspace, view, "test", "baked", [entry.name for entry in session.get_inputs()])
        (picture, _) = session.run(None, inputs)
        expected = image(tiny / "evaluation" / f"{view.name}.prediction.png").transpose(2, 0, 1)
        assert np.abs(picture[0] - expected).mean() < 0.004
        assert np.sqrt(((picture[0] - expected) ** 2).mean()) < 0.01


def test_a_file_that_differs_is_not_written(tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The check is real: with another tolerance it refuses, and leaves nothing."""
    from dnrpipe.core.console import Console
    from dnrpipe.core.errors import UserError
    from dnrpipe.core.workspace import Workspace
    from dnrpipe.export import onnx

    monkeypatch.setattr(onnx, "TOLERANCE", 0.0)
    with pytest.raises(UserError, match="differ from torch"):
        onnx.export_onnx(Workspace.open(tiny), tmp_path / "m.onnx", Console(quiet=True))
    assert list(tmp_path.iterdir()) == []


def test_refusals_are_one_line(tiny: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(tiny, tmp_path / "x.dnr", ignore=shutil.ignore_patterns("step2", "evaluation"))
    for arguments, words in (
        ((str(tmp_path / "x.dnr"), "--out", str(tmp_path / "a.onnx")), "no finished model"),
        ((str(tiny), "--out", "a.txt"), "ends in .onnx"),
        ((str(tmp_path / "nowhere.dnr"),), "not a dnrpipe workspace"),
    ):
        assert _main(["export-onnx", *arguments]) == 2
        said = capsys.readouterr().err
        assert words in said and len(said.splitlines()) == 1
