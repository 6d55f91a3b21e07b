"""The shipped samplers on touches as the estimator's intake passes them on."""

import json
from pathlib import Path

import pytest

from taxeld_training.cli import main
from taxeld_training.filters.conditions import Conditions
from taxeld_training.filters.skins import FLOOR, SKINS
from taxeld_training.filters.touches import firmest
from taxeld_training.objects.setting import Setting, ring
from taxeld_training.samplers.trained import model_of


def test_the_shipped_mugs_samplers_are_near_the_posterior_of_what_the_filter_sees(
    tmp_path: Path,
) -> None:
    """On skins that sag and couple, too: nearer than the table, which has learned nothing."""
    arguments = ["evaluate", "skins", "--quick", "--objects", "025_mug", "--workers", "1"]
    assert main([*arguments, "--out", str(tmp_path), "--memory", str(tmp_path / "memory")]) == 0
    rows = json.loads((tmp_path / "skins.json").read_text(encoding="utf-8"))
    found = {(row["skin"], row["proposal"]): row["energy_distance"] for row in rows}
    for skin in SKINS:
        assert found[skin, "density-64"] < 0.08
        assert found[skin, "density-64"] < found[skin, "projection"] / 10.0
        assert found[skin, FLOOR] < 0.08
    assert "| 025_mug | poor | " in (tmp_path / "skins.md").read_text(encoding="utf-8")


def test_an_object_without_a_shipped_bundle_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["evaluate", "skins", "--quick", "--objects", "061_foam_brick", "--workers", "1"]
    assert main([*arguments, "--out", str(tmp_path), "--memory", str(tmp_path / "memory")]) == 2
    assert (
        capsys.readouterr()
        .err.strip()
        .endswith("061_foam_brick: no bundle of it is shipped for this skin")
    )


def test_of_each_touch_the_firmest_scan_is_taken() -> None:
    model = model_of(Setting("003_cracker_box", ring(16), 16))
    found = firmest(model, range(2), 4, Conditions())
    assert 6 <= len(found) <= 8  # a light touch may not be felt
    assert all(seen.is_contact for seen in found)
    assert all((seen.z[seen.z > 0.0] >= 0.1).all() for seen in found)
