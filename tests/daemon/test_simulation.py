"""Daemons on a fake clock with drawn faults; TAXELD_TEST_SEED draws others."""

from pathlib import Path

import pytest

from tests.rig.simulation import as_bytes, simulate

SEEDS = range(5)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_daemon_with_drawn_faults_keeps_its_laws(seed: int, tmp_path: Path) -> None:
    run, broken = simulate(seed, tmp_path)
    assert broken == [], run.world.faults


def test_the_same_seed_leads_to_the_same_run(tmp_path: Path) -> None:
    first, again = (simulate(5, tmp_path / name)[0] for name in ("first", "again"))
    assert [as_bytes(e) for e in first.estimates] == [as_bytes(e) for e in again.estimates]
    assert first.world.taken == again.world.taken
