"""The named skins of scenarios: what their taxels and presses draw lies where recordings lie."""

from pathlib import Path

import numpy as np
import pytest

from taxeld.config.toml_tables import ConfigError
from taxeld.errors import SetupError
from taxeld_hil import cli
from taxeld_hil.experiment import curves
from taxeld_hil.experiment.curves import AFTER_S
from taxeld_hil.scenario import scenario
from taxeld_hil.scenario.mesh_config import PLAIN, POOR, STIFF, TYPICAL
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.world.spread import PerPress, drawn

BOX = Scenario("box")
SKINS = 60  # drawn of each kind


def written(text: str, place: Path) -> Scenario:
    (place / "s.toml").write_text(f'bundle = "box"\n{text}', encoding="utf-8")
    return scenario.load(str(place / "s.toml"))


def test_on_the_typical_skin_every_figure_lies_in_the_recordings_band() -> None:
    found = curves.figures(curves.measured(BOX.on("typical"), SKINS))
    assert len(found) == len(curves.BANDS)
    assert [row for row in found if not row["inside"]] == []


def test_on_the_poor_skin_every_press_is_as_bad_as_one_in_ten() -> None:
    found = curves.figures(curves.measured(BOX.on("poor"), 20))
    tail = [row for row in found if row["quantile"] == "p90" and row["name"] != "noise"]
    assert len(tail) > 5
    assert [row for row in tail if not row["inside"]] == []
    assert BOX.on("poor").skin.noise_counts == (90.0, 90.0)  # of a large patch


def test_the_stiff_skin_hardly_sags_keeps_or_couples() -> None:
    found = curves.measured(BOX.on("stiff"), 10)
    assert np.quantile(found.residue, 0.9) < 0.007
    assert np.quantile(found.sag[:, 2], 0.9) < 0.01
    assert np.quantile(found.cross_talk, 0.9) < 0.01
    assert np.quantile(curves.widest(found), 0.9) < 0.007


def test_skins_differ_by_their_seed_and_a_seed_draws_the_same_again() -> None:
    one, same, other = (curves.measured(BOX, 1, seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(one.residue, same.residue)
    assert not np.array_equal(one.residue, other.residue)
    assert one.residue.shape == (16, len(AFTER_S))


def test_a_lognormal_has_the_two_quantiles_that_it_is_given() -> None:
    values = drawn((2.0, 7.0), np.random.default_rng(0).standard_normal(100_000))
    np.testing.assert_allclose(np.quantile(values, [0.5, 0.9]), [2.0, 7.0], rtol=0.02)
    rng = np.random.default_rng(1)
    many = np.concatenate([PerPress((2.0, 7.0), 10, rng).now for _ in range(10_000)])
    np.testing.assert_allclose(np.quantile(many, [0.5, 0.9]), [2.0, 7.0], rtol=0.05)
    assert not drawn((0.0, 0.0), np.ones(3)).any()
    np.testing.assert_allclose(drawn((3.0, 3.0), np.array([-5.0, 5.0])), 3.0)


def test_a_scenario_names_a_skin_and_replaces_single_keys_of_it(tmp_path: Path) -> None:
    assert written("", tmp_path).skin == TYPICAL
    assert written('physics = "stiff"', tmp_path).skin == STIFF
    given = written('physics = "poor"\n[mesh]\nsag_m = [0.0019, 0.006]', tmp_path)
    assert given.skin.sag_m == TYPICAL.sag_m
    assert given.skin.residue_slow == POOR.residue_slow
    assert given.on("stiff").skin.sag_m == TYPICAL.sag_m, "its own keys go with it to another skin"
    assert written('physics = "scene"', tmp_path).skin == PLAIN


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ('physics = "mesh"', "physics: must be one of scene, typical, poor, stiff, not 'mesh'"),
        ("[mesh]\nsag_m = 0.003", "mesh.sag_m: must be a list of 2 (float), not 0.003"),
        ("[mesh]\nsag_m = [0.003, 0.001]", r"mesh.sag_m: must be \[median, 90th percentile\]"),
        ("[mesh]\nresidue = [0.0, 0.1]", r"mesh.residue: must be \[0, 0\] or of a median over 0"),
        ("[mesh]\ncreep = 0.1", "mesh.creep: unknown key; known: taxel_radius_m"),
        ("mesh = 3", r"mesh: must be a table \[mesh\]"),
    ],
)
def test_a_wrong_skin_is_refused_with_what_is_wrong_and_where(
    text: str, fault: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=fault.replace("(float)", r"\(float\)")):
        written(text, tmp_path)


def test_a_skin_that_is_not_there_names_those_that_are(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SetupError, match="no skin 'marble'; there are scene, typical, poor, stiff"):
        BOX.on("marble")
    for command in (["run", "demo"], ["soak"], ["table"]):
        assert cli.main([*command, "--skin", "marble"]) == 2
        assert capsys.readouterr().err == (
            "no skin 'marble'; there are scene, typical, poor, stiff\n"
        )
