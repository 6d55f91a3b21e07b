"""Which hypothesis contacts are for: the object stands, it has moved, or it is something else."""

from collections.abc import Iterable

import numpy as np
import pytest

from taxeld.arrays import Poses
from taxeld.estimator import particles as pf
from taxeld.estimator.estimate import Hypotheses
from taxeld.estimator.evidence import ModelEvidence, odds
from taxeld.estimator.memory import Memory
from taxeld.model import contacts, se2
from taxeld.model.noise import Noise
from taxeld.model.observation import Observation, ObservationModel
from taxeld.model.symmetry import PoseMetric

from ..rig.pressed_box import box_side

HERE, THERE = np.zeros(3), np.array([0.1, -0.1, 1.2])
SIDES = (0.2, 1.3, 2.9, 4.5, 3.6, 5.2, 0.7, 2.2)


class Felt:
    """Contacts with a box one after the other, and what is believed of it."""

    def __init__(self, model: ObservationModel) -> None:
        self._model = model
        self.memory, self.log_z, self.contacts = Memory(model, Noise(0.04)), 0.0, 0
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
            self.memory = self.memory.plus(scan, self.contacts, self.log_z)
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
    belief = pf.equal(wide, np.full((len(wide), 1), felt.memory.anything[0]))
    assert felt.evidence.of(belief, felt.memory.runs) == pytest.approx(0.0, abs=1.0)
    narrow = pf.equal(wide[:3], belief.remembered[:3])
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


def test_one_contact_does_not_tell_that_the_object_has_moved(felt: Felt) -> None:
    felt.touch(SIDES[:1])
    for at in (HERE, THERE):
        assert felt.weighed(at)[0].moved == 0.0


def test_a_contact_that_is_elsewhere_tells_that_the_object_stands_no_more(felt: Felt) -> None:
    felt.touch(SIDES[:5])
    assert felt.weighed()[0].stands > 0.8
    felt.touch(SIDES[:1], THERE)
    assert felt.weighed()[0].stands < 0.5


def test_a_belief_that_explains_all_since_a_move_has_the_object_and_it_has_moved(
    felt: Felt,
) -> None:
    felt.touch(SIDES[:3])
    felt.touch(2 * SIDES, THERE)
    hypotheses, here, _ = felt.weighed(THERE)
    assert hypotheses.moved > 0.9
    assert here > 0.9


def test_contacts_that_no_pose_explains_tell_of_something_else(felt: Felt) -> None:
    felt.touch(SIDES, mixed=True)
    assert felt.weighed()[0].other > 0.9
    assert felt.weighed()[1] < 0.1
