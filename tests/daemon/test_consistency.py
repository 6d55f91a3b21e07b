"""How far the belief may deviate from what is remembered before it is refuted."""

import numpy as np
import pytest

from taxeld.estimator import consistency
from taxeld.estimator import particles as pf
from taxeld.estimator.memory import Memory, Prior
from taxeld.model.observation import Noise, Observation, ObservationModel
from taxeld.model.symmetry import PoseMetric

AT = np.zeros((1, 3))


def prior(model: ObservationModel) -> Prior:
    poses = np.random.default_rng(0).standard_normal((500, 3)) * [0.003, 0.003, 0.05]
    weight = np.full(500, 1.0 / 500)
    metric = PoseMetric(model.scene)
    return Prior(metric, poses, weight, metric.modes(poses, weight, 0.05, 5, 64))


@pytest.mark.parametrize(("deviance", "refuted"), [(9.5, False), (10.5, True)])
def test_a_prior_may_be_left_as_far_as_a_silent_scan(
    box_model: ObservationModel, deviance: float, refuted: bool
) -> None:
    known = prior(box_model)
    memory = Memory(box_model, Noise(), known)
    taxels = len(box_model.layout)
    memory.add(Observation(AT[0], np.zeros(taxels), np.ones(taxels, dtype=np.bool_)))
    remembered = np.array([[known.ceiling - deviance, memory.ceiling[0] - deviance]])
    belief = pf.equal(AT, remembered)
    assert consistency.refutes_prior(memory, belief) is refuted
    assert bool(consistency.excess(memory, belief)[0] > 0.0) is refuted


@pytest.mark.parametrize(
    ("refuted", "times"),
    [([1], 1), ([1, 2, 3], 1), ([3], 1), ([3, 4], 2), ([1, 2, 4], 2), ([1, 3, 5], 3), ([], 0)],
)
def test_contacts_before_all_that_agree_are_refuted_once_and_others_each(
    box_model: ObservationModel, refuted: list[int], times: int
) -> None:
    """An object that has moved leaves all before behind; one of another shape contradicts here and
    there. A contact of which a scan agrees is not refuted, and silence is no contact."""
    memory = Memory(box_model, Noise())
    pressed = np.zeros(len(box_model.layout))
    live = np.ones(len(pressed), dtype=np.bool_)
    kept = []
    for contact in range(1, 7):
        for z, is_kept in ((0.5, contact not in refuted), (0.4, contact == 6), (0.0, False)):
            pressed[3] = z
            memory.add(Observation(AT[0], pressed.copy(), live), contact)
            kept.append(is_kept)
    assert consistency.contradictions(memory, np.array(kept)) == times


@pytest.mark.parametrize(("deviance", "excessive"), [(14.0, False), (35.0, True)])
@pytest.mark.parametrize("scans", [1, 13])
def test_a_contact_of_many_scans_deviates_as_much_as_one_of_a_single_scan(
    box_model: ObservationModel, scans: int, deviance: float, excessive: bool
) -> None:
    """So a false press that lasted, of which each scan is bad but possible, is one bad contact
    among others, and not many."""
    memory = Memory(box_model, Noise())
    pressed = np.zeros(len(box_model.layout))
    pressed[:8] = 0.5
    live = np.ones(len(pressed), dtype=np.bool_)
    numbers = [1] * scans + [2, 3]
    for number in numbers:
        memory.add(Observation(AT[0], pressed, live), number)
    deviant = np.array([deviance if number == 1 else 5.0 for number in numbers])
    belief = pf.equal(AT, (memory.ceiling - deviant)[None])
    assert consistency.is_excessive(memory, belief) is excessive


@pytest.mark.parametrize(("a_taxel", "excessive"), [(1.0, False), (2.5, True)])
def test_many_contacts_that_deviate_alike_are_no_more_in_doubt_than_a_few(
    box_model: ObservationModel, a_taxel: float, excessive: bool
) -> None:
    """A soft skin that nobody has calibrated reads each taxel a little wrong, and more contacts do
    not average that out; an object of another shape deviates by more, at each number of them."""
    memory = Memory(box_model, Noise())
    pressed = np.zeros(len(box_model.layout))
    pressed[:6] = 0.5
    live = np.ones(len(pressed), dtype=np.bool_)
    for number in range(1, 17):
        memory.add(Observation(AT[0], pressed, live), number)
        if number in (4, 16):
            deviant = np.full(number, consistency.USUAL + 6 * a_taxel)
            belief = pf.equal(AT, (memory.ceiling - deviant)[None])
            assert consistency.is_excessive(memory, belief) is excessive
