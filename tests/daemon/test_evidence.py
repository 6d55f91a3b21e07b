"""Which hypothesis contacts are for: the object stands, it has moved, or it is something else."""

from collections.abc import Iterable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from taxeld.arrays import Floats, Poses
from taxeld.estimator import particles as pf
from taxeld.estimator.estimate import Hypotheses
from taxeld.estimator.evidence import HAZARD, MEANINGLESS, ModelEvidence, Runs, odds
from taxeld.estimator.memory import Memory
from taxeld.estimator.particles import Explained
from taxeld.estimator.priors import BeliefPrior
from taxeld.model import contacts, se2
from taxeld.model.noise import Noise
from taxeld.model.observation import Observation, ObservationModel
from taxeld.model.symmetry import PoseMetric

from ..rig.memories import memory_of, plus
from ..rig.pressed_box import box_side

EVIDENCE, USUAL = 5.0, -12.0  # of all before the newest contact; of a contact of anything [nats]
HERE, THERE = np.zeros(3), np.array([0.1, -0.1, 1.2])
SIDES = (0.2, 1.3, 2.9, 4.5, 3.6, 5.2, 0.7, 2.2)
nats = st.floats(-60.0, 60.0)


def of_contacts(n: int, scans: int = 1) -> Runs:
    """n contacts of as many scans each, and no silence; before each but the first there is the
    same evidence."""
    shares = np.hstack([np.repeat(np.eye(n), scans, axis=0) / scans, np.zeros((n * scans, n))])
    none, steps = np.empty((0, 2 * n)), np.ones(n, np.bool_)
    begun = np.full(n, np.log(HAZARD) + EVIDENCE)
    begun[0] = 0.0
    return Runs(np.arange(n), shares, none, np.repeat([USUAL, 0.0], n), steps, begun, begun)


def explained(scans: Floats, *priors: float) -> Explained:
    """Of poses (N, K), or of one (K,), which priors find alike."""
    of_scans = np.atleast_2d(scans)
    return Explained(of_scans, np.tile(priors, (len(of_scans), 1)))


def support(runs: Runs, *told: float) -> float:
    return float(runs.support(explained(np.array(told)))[0])


def worth(nats: float) -> float:
    """A contact by these nats, which may mean nothing."""
    return float(np.exp(nats)) + MEANINGLESS


@pytest.mark.parametrize(
    ("told", "expected"),
    [
        pytest.param([4.0], np.log(worth(4.0)), id="by how much likelier the pose makes it"),
        pytest.param([-1e5], np.log(MEANINGLESS), id="it may mean nothing, and costs no more"),
        pytest.param(
            [-3.0, 4.0],
            np.log(worth(-3.0) * worth(4.0) + HAZARD * np.exp(EVIDENCE) * worth(4.0)),
            id="it stood for both, or moved and the second counts alone",
        ),
    ],
)
def test_what_contacts_are_worth(told: list[float], expected: float) -> None:
    assert support(of_contacts(len(told)), *(USUAL + each for each in told)) == pytest.approx(
        expected
    )


@given(st.lists(st.tuples(nats, nats, nats), min_size=1, max_size=6), st.permutations(range(3)))
def test_scans_of_a_contact_count_as_one_in_any_order(
    told: list[tuple[float, ...]], order: list[int]
) -> None:
    """And a pose is supported by all runs together."""
    runs, given_scans = of_contacts(len(told), scans=3), np.array(told)
    found = support(runs, *given_scans.ravel())
    assert support(runs, *given_scans[:, order].ravel()) == pytest.approx(found)
    alone = of_contacts(len(told))
    assert support(alone, *given_scans.mean(axis=1)) == pytest.approx(found)
    each = alone.each(explained(given_scans.mean(axis=1)))
    assert each.max() - 1e-9 <= found <= each.max() + np.log(len(told)) + 1e-9


def prior(model: ObservationModel) -> BeliefPrior:
    poses = 1e-3 * np.random.default_rng(0).standard_normal((50, 3))
    metric, weight = PoseMetric(model.scene), np.full(50, 0.02)
    return BeliefPrior(metric, poses, weight, metric.modes(poses, weight, 0.05, 5, 64))


def remembered(
    model: ObservationModel, scans: list[tuple[int, bool]], known: BeliefPrior | None = None
) -> Memory:
    """Scans of contacts by number, or of the silence after them."""
    memory, live = memory_of(model, Noise(), earlier=known), np.ones(len(model.layout), np.bool_)
    for number, touched in scans:
        z: Floats = np.where(np.arange(len(live)) < 3 * touched, 0.5, 0.0)
        memory = plus(memory, Observation(np.zeros(3), z, live), number, EVIDENCE)
    return memory


def test_a_prior_counts_only_as_long_as_the_object_has_stood(box_model: ObservationModel) -> None:
    known = prior(box_model)
    runs = remembered(box_model, [(1, True), (2, True)], known).runs
    usual, known_here = (runs.each(explained(np.zeros(2), by)) for by in (0.0, 2.5))
    assert np.allclose(known_here - usual, [[2.5, 0.0]])
    alone = memory_of(box_model, Noise(), earlier=known)
    assert alone.runs.support(explained(np.empty(0), 2.5)) == [2.5]
    assert (
        memory_of(box_model, Noise()).runs.support(explained(np.empty((3, 0)))).tolist()
        == [0.0] * 3
    )


def test_silence_tells_of_the_object_from_the_next_contact_on(box_model: ObservationModel) -> None:
    """It may have moved after the contact before. No silence means nothing."""
    runs = remembered(box_model, [(1, True), (1, False), (2, True)]).runs
    cost = runs.each(explained(np.zeros(3))) - runs.each(explained(np.array([0.0, -1e4, 0.0])))
    assert np.allclose(cost, 1e4)
    assert runs.touched.tolist() == [True, True]
    runs = remembered(box_model, [(1, True), (2, True), (2, False)]).runs
    assert runs.touched.tolist() == [True, True, False]
    assert np.isinf(runs.open).tolist() == [False, False, True]


class Felt:
    """Contacts with a box one after the other, and what is believed of it."""

    def __init__(self, model: ObservationModel) -> None:
        self._model = model
        self.memory, self.log_z, self.contacts = memory_of(model, Noise(0.04)), 0.0, 0
        self.evidence = ModelEvidence(model, PoseMetric(model.scene))

    def touch(self, sides: Iterable[float], at: Poses = HERE, *, mixed: bool = False) -> None:
        """Presses of the box at a pose from some sides; `mixed`: readings in disorder."""
        for side in sides:
            seen = box_side(self._model, side, 0.003)
            z = self._model.activation(se2.inverse(seen)[None])[0]
            if mixed:
                z = np.random.default_rng(self.contacts).permutation(z)
            scan = Observation(se2.compose(at, seen), z, np.ones(len(z), np.bool_))
            self.contacts += 1
            self.memory = plus(self.memory, scan, self.contacts, self.log_z)
            *_, self.log_z = self.weighed(at)

    def weighed(self, at: Poses = HERE) -> tuple[Hypotheses, float, float]:
        """The hypotheses of a narrow belief about a pose."""
        spread = np.random.default_rng(0).standard_normal((200, 3)) * (5e-4, 5e-4, 5e-3)
        belief = pf.equal(at + spread, self.memory.explain(at + spread))
        weighed = self.evidence.weighed(belief, self.memory.runs)
        hypotheses, here, *_ = odds([weighed])
        return hypotheses, float(here[0]), weighed.log_z


@pytest.fixture
def felt(box_model: ObservationModel) -> Felt:
    return Felt(box_model)


def test_a_belief_as_wide_as_what_can_be_touched_has_no_evidence(
    box_model: ObservationModel, felt: Felt
) -> None:
    """Where it explains the first contact as well as anything does."""
    felt.touch(SIDES[:1])
    wide = contacts.synthesise(box_model.scene, 0.04, 0.005, 30_000, np.random.default_rng(0)).pose
    belief = pf.equal(wide, explained(np.full((len(wide), 1), felt.memory.background[0])))
    assert felt.evidence.of(belief, felt.memory.runs) == pytest.approx(0.0, abs=1.0)
    narrow = pf.equal(wide[:3], explained(belief.explained.scans[:3]))
    assert felt.evidence.of(narrow, felt.memory.runs) < -5.0


def test_each_contact_that_is_explained_adds_evidence_of_the_object(felt: Felt) -> None:
    evidence, other = [], []
    for side in SIDES:
        felt.touch([side])
        hypotheses, here, log_z = felt.weighed()
        assert sum(hypotheses) == pytest.approx(1.0)
        assert hypotheses.stands <= here <= 1.0
        evidence.append(log_z)
        other.append(hypotheses.other)
    assert np.diff(evidence).min() > -1.0
    assert evidence[-1] > evidence[0] + 10.0
    assert other[0] > 0.05
    assert other[-1] < 0.01


def test_a_contact_that_is_elsewhere_tells_of_a_move_but_not_the_first_one(felt: Felt) -> None:
    felt.touch(SIDES[:1])
    assert [felt.weighed(at)[0].moved for at in (HERE, THERE)] == [0.0, 0.0]
    felt.touch(SIDES[1:5])
    assert felt.weighed()[0].stands > 0.8
    felt.touch(SIDES[:1], THERE)
    assert felt.weighed()[0].stands < 0.5
    felt.touch(2 * SIDES, THERE)
    hypotheses, here, _ = felt.weighed(THERE)
    assert hypotheses.moved > 0.9
    assert here > 0.9


def test_contacts_that_no_pose_explains_tell_of_something_else(felt: Felt) -> None:
    felt.touch(SIDES, mixed=True)
    assert felt.weighed()[0].other > 0.9
    assert felt.weighed()[1] < 0.1
