"""The comparison of the two models of a skin: what it reports, and its closed forms."""

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from taxeld import bundle, layout
from taxeld.observation import Noise
from taxeld_hil import cli, physics_cost, physics_gap, scenario
from taxeld_hil.mesh_world import solid_of
from taxeld_hil.physics_gap import STAGES, Bench, Readings

DEMO = scenario.load("demo")
SKIN = layout.load(DEMO.layout)


def test_readings_with_the_assumed_noise_are_found_honest() -> None:
    rng = np.random.default_rng(0)
    expected = np.tile(rng.uniform(0.05, 0.6, (400, 1)), len(SKIN))
    z = Noise(0.02, 0.17, 0.0).draw(expected, rng)
    readings = Readings(expected, np.stack([z] * len(STAGES)), np.full(400, 0.002), np.zeros(400))
    told = physics_gap.compare(readings, SKIN, Noise())["noise"]
    assert told["rms_in_sd"] == pytest.approx(1.0, abs=0.03)
    assert told["over_3_sd"] < 0.005
    assert 0.014 < told["best"]["sigma"] < 0.027
    assert told["best"]["gain_cv"] == pytest.approx(0.17, abs=0.03)


def test_equal_models_do_not_differ() -> None:
    expected = np.random.default_rng(0).uniform(0.0, 1.0, (50, len(SKIN)))
    readings = Readings(
        expected, np.stack([expected] * len(STAGES)), np.full(50, 0.001), np.zeros(50)
    )
    told = physics_gap.compare(readings, SKIN, Noise())
    assert all(stage["rms"] == 0.0 == stage["step_rms"] for stage in told["stages"])
    assert told["felt_unexpected"] == told["expected_unfelt"] == 0.0


def test_the_same_seed_compares_the_same_readings() -> None:
    model = bundle.load("mug", SKIN, 0.005).model
    bench = Bench(DEMO, model, solid_of("mug", SKIN))
    one, other = (bench.readings(5, np.random.default_rng(3), lambda _: None) for _ in range(2))
    np.testing.assert_array_equal(one.read, other.read)
    assert one.read.shape == (len(STAGES), 10, len(SKIN))
    assert one.receding.tolist() == [0.0, 1.0] * 5


def test_kinds_add_one_effect_after_the_other_up_to_all() -> None:
    kinds = [mesh for mesh in physics_cost.KINDS.values() if mesh is not None]
    names = type(kinds[0]).__dataclass_fields__
    changed = [{n for n in names if getattr(a, n) != getattr(b, n)} for a, b in pairwise(kinds)]
    assert all(changed)
    assert sum(map(len, changed)) == len(set.union(*changed))
    assert kinds[-1] == DEMO.mesh


def test_figures_that_are_none_are_refused_with_a_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for option, value, message in (("--noise-sigma", "-1", "filter.noise_sigma: must be"),
                                   ("--contacts", "0", "--contacts must be at least"),
                                   ("--object", "party", "no bundle 'party'")):  # fmt: skip
        assert cli.main(["physics", option, value, "--out", str(tmp_path)]) == 2
        assert message in capsys.readouterr().err


def test_the_command_writes_json_beside_a_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    assert not cli.main(["physics", "--quick", "--object", "box", "--contacts", "12",
                         "--seeds", "1", "--out", str(tmp_path)])  # fmt: skip
    said = capsys.readouterr()
    assert "box, a cover that sags 3 mm: 12 of 12 contacts" in said.err
    result = json.loads((tmp_path / "physics.json").read_text(encoding="utf-8"))
    assert [stage["stage"] for stage in result["gap"]["box"]["stages"]] == list(STAGES)
    assert [row["kind"] for row in result["cost"]] == list(physics_cost.KINDS)
    assert (tmp_path / "physics.png").stat().st_size < 300_000
