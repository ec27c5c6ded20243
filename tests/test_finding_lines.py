"""Findings as lines: nothing is lost, and what recurs is said once."""

from __future__ import annotations

from dnrpipe.blender.findings import LISTED, finding_lines
from dnrpipe.core.scene_records import Finding, FindingKind


def _row(feature: str, note: str, kind: FindingKind = "ignored", **names: str) -> Finding:
    return Finding.model_validate(
        {"object": None, "material": None, **names, "kind": kind, "feature": feature, "note": note}
    )


def test_a_few_get_a_line_each_with_their_names() -> None:
    rows = [_row("volume", "left out", object="Cloud"), _row("volume", "left out", object="Fog", material="Mist")]
    assert finding_lines(rows) == [
        "volume (object 'Cloud'): left out",
        "volume (object 'Fog', material 'Mist'): left out",
    ]


def test_many_share_a_line_that_counts_them() -> None:
    rows = [_row("hair", f"{n} strands", object=f"Head {n}") for n in range(LISTED + 5)]
    (line,) = finding_lines([*rows])
    assert "object 'Head 0'" in line and f"'Head {LISTED}'" not in line
    assert line.endswith("and 5 more): 0 strands; and alike (--json has each)")


def test_other_kinds_and_features_stay_apart() -> None:
    rows = [_row("hair", "x", object=str(n)) for n in range(5)] + [_row("fog", "y")]
    rows.append(_row("hair", "x", kind="baked", object="baked"))
    assert finding_lines(rows)[1:] == ["fog: y", "hair (object 'baked'): x"]
