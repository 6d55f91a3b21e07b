"""The named skins of scenarios, and the distributions that their taxels and presses draw from."""

from pathlib import Path

import numpy as np
import pytest

from taxeld.config.toml_tables import ConfigError
from taxeld_hil.scenario import scenario
from taxeld_hil.scenario.mesh_config import PLAIN, POOR, STIFF, TYPICAL
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.world.spread import PerPress, drawn

BOX = Scenario("box")


def written(text: str, place: Path) -> Scenario:
    (place / "s.toml").write_text(f'bundle = "box"\n{text}', encoding="utf-8")
    return scenario.load(str(place / "s.toml"))


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
