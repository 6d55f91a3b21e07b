"""The comparison of the two models of a skin: what it reports, and its closed forms."""

import json
from pathlib import Path

import numpy as np
import pytest

from taxeld.layout import read as layouts
from taxeld.model.observation import Noise
from taxeld.proposals import bundle
from taxeld_hil import cli
from taxeld_hil.experiment import physics_experiment, physics_gap
from taxeld_hil.experiment.physics_gap import STAGES, ContactReadings, SkinComparison
from taxeld_hil.scenario import scenario
from taxeld_hil.world.bundled import solid_of

DEMO = scenario.load("demo").on("typical")
SKIN = layouts.load(DEMO.layout)


def test_the_noise_that_readings_were_drawn_with_is_found_again() -> None:
    rng = np.random.default_rng(0)
    expected = np.tile(rng.uniform(0.05, 0.6, (400, 1)), len(SKIN))
    z = Noise(0.02, 0.17, 0.0).draw(expected, rng)
    readings = ContactReadings(
        expected, np.stack([z] * len(STAGES)), np.full(400, 0.002), np.zeros(400)
    )
    found = physics_gap.compare(readings, SKIN, Noise())["noise"]
    assert found["rms_in_sd"] == pytest.approx(1.0, abs=0.03)
    assert found["over_3_sd"] < 0.005
    assert 0.014 < found["best"]["sigma"] < 0.027
    assert found["best"]["gain_cv"] == pytest.approx(0.17, abs=0.03)


def test_equal_models_have_no_difference() -> None:
    expected = np.random.default_rng(0).uniform(0.0, 1.0, (50, len(SKIN)))
    readings = ContactReadings(
        expected, np.stack([expected] * len(STAGES)), np.full(50, 0.001), np.zeros(50)
    )
    found = physics_gap.compare(readings, SKIN, Noise())
    assert all(stage["rms"] == 0.0 == stage["step_rms"] for stage in found["stages"])
    assert found["felt_unexpected"] == found["expected_unfelt"] == 0.0


def test_the_same_seed_compares_the_same_readings() -> None:
    model = bundle.load("mug", SKIN, 0.005).model
    skins = SkinComparison(DEMO, model, solid_of("mug", SKIN))
    one, other = (skins.readings(5, np.random.default_rng(3), lambda _: None) for _ in range(2))
    np.testing.assert_array_equal(one.read, other.read)
    assert one.read.shape == (len(STAGES), 10, len(SKIN))
    assert one.receding.tolist() == [0.0, 1.0] * 5


def test_wrong_options_are_refused_with_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for option, value, message in (("--noise-sigma", "-1", "filter.noise_sigma: must be"),
                                   ("--skin", "scene", "--skin scene: is no soft skin"),
                                   ("--contacts", "0", "--contacts must be at least"),
                                   ("--object", "party", "no bundle 'party'")):  # fmt: skip
        assert cli.main(["physics", option, value, "--out", str(tmp_path)]) == 2
        assert message in capsys.readouterr().err


def test_the_command_writes_json_beside_a_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    assert not cli.main(["physics", "--quick", "--object", "box", "--contacts", "12",
                         "--out", str(tmp_path)])  # fmt: skip
    printed = capsys.readouterr()
    assert "box: 12 of 12 contacts" in printed.err
    result = json.loads((tmp_path / "physics.json").read_text(encoding="utf-8"))
    assert [stage["stage"] for stage in result["gap"]["box"]["stages"]] == list(STAGES)
    assert printed.out.splitlines()[2:] == list(physics_experiment.lines(tmp_path / "physics.json"))
    assert "| sag | " in printed.out
    assert (tmp_path / "physics.png").stat().st_size < 300_000
