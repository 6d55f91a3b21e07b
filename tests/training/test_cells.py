"""Cells of trials: what is trained for them, remembered of them, and counted in them."""

import math
import time
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from taxeld.config.tables import FilterConfig
from taxeld.estimator import scans
from taxeld.estimator.estimate import Status
from taxeld.estimator.estimator import Estimator
from taxeld.estimator.scans import noise_of
from taxeld.model import se2
from taxeld.model.observation import ObservationModel
from taxeld.proposals.analytic import ANALYTIC
from taxeld_hil.integrity import FOUND_MM
from taxeld_training.filters import cells, follow, methods, stability, whole
from taxeld_training.filters.cells import Cell
from taxeld_training.filters.conditions import TrialConditions
from taxeld_training.filters.levels import LEVELS, Level
from taxeld_training.filters.methods import SHIPPED, Method, TouchResult
from taxeld_training.filters.stability import p_shipped, shares
from taxeld_training.filters.trials import Trial
from taxeld_training.jobs.options import Options
from taxeld_training.limits.grid_filter import GridFilter
from taxeld_training.objects.setting import Setting, ring
from taxeld_training.samplers import trained

from .rig import written_at

BOX = Setting("003_cracker_box", ring(16), 16)
RIGHT, WRONG = (TouchResult(mm, Status.CONVERGED, 100, 1.0, 0.005) for mm in (1.0, 99.0))


@pytest.fixture
def small(block: Path) -> Setting:
    return Setting(str(block), ring(8), 8, updates=0.001)


def lengths(name: str) -> Setting:
    level = next(level for level in LEVELS if level.name == f"lengths={name}")
    return level.setting(BOX.object, Options(Path(), Path()))


def test_a_shipped_density_is_not_trained() -> None:
    assert not trained.is_learned("density", BOX)
    assert trained.is_learned("density", replace(BOX, skin=ring(8), columns=8))
    assert trained.is_learned("paper", BOX)  # no bundle has the paper's
    assert not trained.is_learned("table", BOX)
    assert trained.proposal_of("density", BOX, "").name == "density"
    assert trained.shipped(lengths("usual")) is not None
    assert trained.shipped(lengths("object 300 mm")) is None
    assert trained.shipped(lengths("depth 2 mm")) is None


def test_a_world_that_is_smaller_in_all_is_the_same_but_for_its_lengths() -> None:
    usual, little = (trained.model_of(lengths(name)) for name in ("usual", "all by 1/4"))
    assert little.scene.mean_radius == pytest.approx(0.25 * usual.scene.mean_radius, rel=0.02)
    assert little.scene.symmetry == usual.scene.symmetry
    assert np.allclose(little.layout.position_m, 0.25 * usual.layout.position_m)
    assert little.depth_max_m == 0.25 * usual.depth_max_m


@pytest.mark.check
def test_the_papers_own_diffusion_is_run_by_the_papers_own_rule(
    small: Setting, tmp_path: Path
) -> None:
    assert Method("paper", "paper", 100) in whole.FILTERS
    variant = trained.LEARNED["paper"]
    assert (variant.training.contacts, variant.frame, variant.view) == (10_000, "pose", "plain")
    few = replace(variant, network=replace(variant.network, steps=2))  # 100 are slow to export
    file = tmp_path / "paper.onnx"
    trained.train(small, few, str(file))
    ((first, *_),) = cells.play(Cell(small, Method("paper", "paper", 20)), 0, 1, str(file))
    assert math.isfinite(first[0])


def test_more_trials_add_to_those_that_are_remembered(
    small: Setting, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cells, "BLOCK", 2)
    cell = Cell(small, Method("table", "mixture", 10))
    options = Options(tmp_path, tmp_path / "memory", workers=1)
    few = cells.run([(cell, 2)], options)[cell]
    begun = written_at(tmp_path / "memory")
    more = cells.run([(cell, 4)], options)[cell]
    assert {seed: more[seed] for seed in few} == few
    assert (len(few), len(more)) == (2, 4)
    assert begun.items() <= written_at(tmp_path / "memory").items()
    assert more[2] != few[0]
    late = cells.run([(cell, 6)], replace(options, until=time.monotonic() - 1.0))[cell]
    assert late == more  # the seeds that are there


def test_the_filter_that_experiments_call_shipped_is_the_daemons_own() -> None:
    """Nothing of the configuration is an experiment's copy."""
    assert SHIPPED.config(FilterConfig().seed) == FilterConfig()
    ours = Method("table", "paper", 20).config(FilterConfig().seed)
    assert (ours.particles, ours.particles_max, ours.injected) == (20, 20, 10)
    changed = {"particles", "particles_max", "injected", "injection"}
    assert all(
        getattr(ours, f.name) == getattr(FilterConfig(), f.name)
        for f in fields(ours)
        if f.name not in changed
    )
    assert noise_of(FilterConfig()) == methods.NOISE
    assert Method("table", "mixture", 20).config(follow.OWN_SEEDS).seed == follow.OWN_SEEDS


def test_what_misleads_counts_at_its_contact_and_ever_after() -> None:
    trials = {0: [RIGHT, WRONG, RIGHT], 1: [RIGHT, RIGHT, RIGHT]}
    rows = [shares(trials, contact) for contact in (1, 2, 3)]
    assert [row["misleading_rate"] for row in rows] == [0.0, 0.5, 0.0]
    assert [row["misleading_so_far_rate"] for row in rows] == [0.0, 0.5, 0.5]


def test_methods_are_compared_on_the_trials_that_both_have() -> None:
    better = {seed: [RIGHT] for seed in range(10)}
    worse = {seed: [RIGHT if seed < 4 else WRONG] for seed in range(30)}
    assert p_shipped(better, worse, 1) == 2.0 * 0.5**6
    assert p_shipped(better, better, 1) == 1.0
    assert p_shipped(better, None, 1) is None


def test_a_wrong_object_is_never_found() -> None:
    """And a filter that is sure of it misleads."""
    level = Level("wrong object", "003_cracker_box", touched="003_cracker_box")
    mug = Setting("025_mug", ring(16), 16)
    found = cells.play(stability.cell_of(level, Method("table", "mixture", 100), mug), 0, 4, "")
    assert all(math.isnan(error_mm) for trial in found for error_mm, *_ in trial)
    wrong = WRONG._replace(map_mm=math.nan)
    doubted = wrong._replace(status=Status.AMBIGUOUS, p=0.5)
    rates = shares({k: [each] for k, each in enumerate((wrong, wrong, doubted, wrong))}, 1)
    assert (rates["found_rate"], rates["sure_rate"]) == (0.0, 0.75)
    assert rates["misleading_rate"] == rates["misleading_so_far_rate"] == 0.75


@pytest.mark.check
def test_cans_that_a_filter_takes_for_boxes_are_flagged_after_eight_contacts() -> None:
    """Some of a can's contacts agree with a box; of these four trials three ended converged while
    one contradiction asked for no more agreement than many."""
    level = Level("wrong object", "002_master_chef_can", touched="002_master_chef_can")
    found = cells.play(stability.cell_of(level, SHIPPED, BOX), 1038, 4, "")
    last = [Status(trial[-1][1]) for trial in found]
    assert last.count(Status.CONVERGED) <= 1, last


def test_the_grid_learns_from_the_scans_that_the_estimator_learns_from(
    ring_model: ObservationModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As they are after what may leak, and what foam may keep, was taken off."""
    trial = Trial(ring_model, 3, 3, TrialConditions(skin="typical"))
    grid = GridFilter(ring_model, methods.NOISE, follow.SLACK)
    monkeypatch.setattr(follow, "GridFilter", lambda *_: grid)
    follow.follow_grid(trial, ring_model, (3,))
    monkeypatch.setattr(scans, "REMEMBERED", 99)
    config = FilterConfig(injected=0)
    estimator = Estimator(ring_model, ANALYTIC["manifold"](ring_model), config)
    for moment in trial:
        estimator.on_scan(moment.activation, moment.sensor)
    memory = estimator.rule.memory
    touches = [scan for scan in grid._scans if scan.touched]
    remembered = [k for k in range(len(memory)) if memory.contact[k]]
    assert len(grid._scans) == estimator.counters.updates
    assert [scan.contact for scan in touches] == memory.number[remembered].tolist()
    for scan, k in zip(touches, remembered, strict=True):
        kept = memory.scans[k].observation
        assert np.allclose(scan.observation.z, kept.z)
        assert np.allclose(scan.observation.residue, kept.residue)


def test_of_two_objects_of_one_kind_the_nearer_one_counts(ring_model: ObservationModel) -> None:
    trial = Trial(ring_model, 1, 2, TrialConditions(both=2))
    moment = next(iter(trial))
    assert moment.twin is not None
    beside = se2.compose(moment.twin, np.array([0.001, 0.0, 0.0]))
    assert follow.error_mm(ring_model, moment, beside) == pytest.approx(1.0, abs=1e-6)
    alone = moment._replace(twin=None)
    assert follow.error_mm(ring_model, alone, beside) > FOUND_MM
