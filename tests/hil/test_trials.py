"""Trials: one world by two drivers, and what each condition changes."""

from dataclasses import replace

import numpy as np
import pytest

from taxeld.pipeline.pipeline import Pipeline
from taxeld.proposals import bundle, choice
from taxeld_hil.run.fake_run import FakeRun
from taxeld_hil.scenario import scenario
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.trials.play import SCAN_S, TICK_S, Direct
from taxeld_hil.world.world import world_of

LINKS = scenario.load("links")


@pytest.mark.parametrize(
    "subject",
    [
        Scenario("box", contacts=3, physics="scene", transport="can"),
        Scenario("box", contacts=3, physics="typical", transport="can", robot_m=0.002),
        Scenario("mug", contacts=2, physics="poor", transport="slcan"),
        replace(LINKS, contacts=4, transport="can"),
    ],
    ids=lambda each: f"{each.physics} {each.transport} {each.links}",
)
def test_both_drivers_give_the_same_estimates_where_the_wire_loses_nothing(
    subject: Scenario,
) -> None:
    """Bit by bit, scan by scan: from the same first scan on, which a hub sends once it has been
    started."""
    run, wired, firsts = FakeRun(subject, 5), [], []
    for k in range(round(100 * run.duration_s)):
        run.step(k * TICK_S)
        assert run.daemon is not None
        if run.rig.ledger.scans_sent and not firsts:
            firsts.append(k)
        wired.append(run.daemon.pipeline.estimate)
    config = bundle.sized(run.config, [each.manifest for each in run.scenes])
    models = [each.model for each in run.scenes]
    samples = choice.samples(run.scenes, config.filter)
    skins = [link.layout for link in models[0].links]
    direct = Direct(world_of(subject, 5), Pipeline(config, skins, models, samples), firsts[0])
    told = {}
    for outcome in direct.outcomes(run.duration_s):
        told[round(outcome.estimate.t, 6)] = outcome.estimate
    compared = 0
    for estimate in wired:
        mine = told.get(round(estimate.t, 6))
        if estimate.t and mine is not None:
            np.testing.assert_array_equal(mine.map, estimate.map)
            assert (mine.p, mine.contacts) == (estimate.p, estimate.contacts)
            compared += 1
    assert compared > 0.9 * (run.duration_s - 3.0) / SCAN_S
    assert wired[-1].contacts == subject.contacts
