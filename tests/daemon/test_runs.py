"""Since when the object has stood: what contacts tell of a pose, if it may have moved between."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from taxeld.arrays import Floats
from taxeld.estimator.memory import Memory, Prior
from taxeld.estimator.runs import HAZARD, MEANINGLESS, Runs
from taxeld.model.noise import Noise
from taxeld.model.observation import Observation, ObservationModel
from taxeld.model.symmetry import PoseMetric

EVIDENCE = 5.0  # of all before the newest contact [nats]
USUAL = -12.0
nats = st.floats(-60.0, 60.0)


def of_contacts(n: int, scans: int = 1) -> Runs:
    """n contacts of as many scans each, and no silence; before each but the first there is the
    same evidence."""
    shares = np.hstack([np.repeat(np.eye(n), scans, axis=0) / scans, np.zeros((n * scans, n))])
    begun = np.full(n, np.log(HAZARD) + EVIDENCE)
    begun[0] = 0.0
    return Runs(shares, np.repeat([USUAL, 0.0], n), np.ones(n, np.bool_), begun)


def support(runs: Runs, *told: float) -> float:
    return float(runs.support(np.array([told]))[0])


def worth(nats: float) -> float:
    """A contact by these nats, which may mean nothing."""
    return float(np.exp(nats)) + MEANINGLESS


def test_one_contact_counts_by_how_much_likelier_the_pose_makes_it() -> None:
    assert support(of_contacts(1), USUAL + 4.0) == pytest.approx(np.log(worth(4.0)))


def test_of_two_contacts_the_object_stood_for_both_or_moved_and_the_second_counts_alone() -> None:
    stood = worth(-3.0) * worth(4.0)
    moved = HAZARD * np.exp(EVIDENCE) * worth(4.0)
    found = support(of_contacts(2), USUAL - 3.0, USUAL + 4.0)
    assert found == pytest.approx(np.log(stood + moved))


def test_a_contact_that_no_pose_explains_may_mean_nothing_and_costs_no_more_than_that() -> None:
    assert support(of_contacts(1), -1e5) == pytest.approx(np.log(MEANINGLESS))
    given_others = of_contacts(3).each(np.array([[USUAL + 9.0, -1e5, USUAL + 9.0]]))
    assert given_others[0, 0] == pytest.approx(18.0 + np.log(MEANINGLESS), abs=1e-3)


def test_without_scans_a_prior_is_all_that_counts(box_model: ObservationModel) -> None:
    assert Memory(box_model, Noise()).runs.support(np.empty((3, 0))).tolist() == [0.0] * 3
    assert Memory(box_model, Noise(), prior(box_model)).runs.support(np.full((1, 1), 2.5)) == [2.5]


def test_a_prior_counts_only_as_long_as_the_object_has_stood(box_model: ObservationModel) -> None:
    runs = remembered(box_model, [(1, True), (2, True)], prior(box_model)).runs
    usual, known = runs.each(np.zeros((1, 3))), runs.each(np.array([[2.5, 0.0, 0.0]]))
    assert np.allclose(known - usual, [[2.5, 0.0]])


def test_silence_tells_of_the_object_from_the_next_contact_on(box_model: ObservationModel) -> None:
    """It may have moved after the contact before. No silence means nothing."""
    runs = remembered(box_model, [(1, True), (1, False), (2, True)]).runs
    cost = runs.each(np.zeros((1, 3))) - runs.each(np.array([[0.0, -1e4, 0.0]]))
    assert np.allclose(cost, 1e4)
    assert runs.touched.tolist() == [True, True]
    runs = remembered(box_model, [(1, True), (2, True), (2, False)]).runs
    assert runs.touched.tolist() == [True, True, False]


@given(st.lists(st.tuples(nats, nats, nats), min_size=1, max_size=6), st.permutations(range(3)))
def test_scans_of_a_contact_count_as_one_in_any_order(
    told: list[tuple[float, ...]], order: list[int]
) -> None:
    runs, given_scans = of_contacts(len(told), scans=3), np.array(told)
    found = support(runs, *given_scans.ravel())
    assert support(runs, *given_scans[:, order].ravel()) == pytest.approx(found)
    alone = support(of_contacts(len(told)), *given_scans.mean(axis=1))
    assert alone == pytest.approx(found)


@given(st.lists(nats, min_size=1, max_size=12))
def test_a_pose_is_supported_by_all_runs_together(told: list[float]) -> None:
    runs = of_contacts(len(told))
    each, found = runs.each(np.array([told])), support(runs, *told)
    assert each.max() <= found <= each.max() + np.log(len(told)) + 1e-9


def prior(model: ObservationModel) -> Prior:
    poses = 1e-3 * np.random.default_rng(0).standard_normal((50, 3))
    metric, weight = PoseMetric(model.scene), np.full(50, 0.02)
    return Prior(metric, poses, weight, metric.modes(poses, weight, 0.05, 5, 64))


def remembered(
    model: ObservationModel, scans: list[tuple[int, bool]], known: Prior | None = None
) -> Memory:
    """Scans of contacts by number, or of the silence after them."""
    memory, live = Memory(model, Noise(), known), np.ones(len(model.layout), np.bool_)
    for number, touched in scans:
        z: Floats = np.where(np.arange(len(live)) < 3 * touched, 0.5, 0.0)
        memory = memory.plus(Observation(np.zeros(3), z, live), number, EVIDENCE)
    return memory
