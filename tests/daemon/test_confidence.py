"""What confirms, refutes and doubts a belief, and the status that follows from it."""

from collections.abc import Callable

import numpy as np
import pytest

from taxeld.estimator import particles as pf
from taxeld.estimator.confidence import AGREEING, LEAST, SEARCHED, Confidence, status
from taxeld.estimator.estimate import Status
from taxeld.estimator.particles import Belief
from taxeld.model.observation import ObservationModel

Change = Callable[[Confidence], None]


def belief(x: float = 0.0, sd: float = 0.001) -> Belief:
    poses = np.random.default_rng(0).standard_normal((100, 3)) * sd + [x, 0.0, 0.0]
    return pf.equal(poses, np.empty((100, 0)))


@pytest.fixture
def confidence(box_model: ObservationModel) -> Confidence:
    """Of a narrow belief that two contacts and enough samples have left where it was, and that
    explains no more contacts than it must."""
    made = Confidence.of(belief(), box_model.scene)
    for contact in (1, 2):
        made.learned(belief(), SEARCHED // 2, contact, LEAST, in_doubt=False)
    return made


def test_a_narrow_belief_that_stays_is_converged(confidence: Confidence) -> None:
    assert status(confidence, 2) is Status.CONVERGED


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda c: c.learned(belief(0.1), 50, 3, 3, in_doubt=False), Status.AMBIGUOUS),
        (lambda c: c.learned(belief(sd=0.1), 50, 3, 3, in_doubt=False), Status.SEARCHING),
        (lambda c: c.learned(belief(), 50, 3, 3, in_doubt=True), Status.AMBIGUOUS),
        (lambda c: c.revisited(belief(0.1), 50), Status.AMBIGUOUS),
        (lambda c: c.moved(belief()), Status.AMBIGUOUS),
        (lambda c: c.judged(doubt=True), Status.INCONSISTENT),
        (lambda c: c.learned(belief(), 0, 0, LEAST, in_doubt=False), Status.CONVERGED),
        (lambda c: c.revisited(belief(), 50), Status.CONVERGED),
    ],
    ids=[
        "contact moved it",
        "contact widened it",
        "contact ended a doubt",
        "search moved it",
        "object was pushed",
        "contact is in doubt",
        "silence left it",
        "search left it",
    ],
)
def test_what_takes_a_converged_belief_back(
    confidence: Confidence, change: Change, expected: Status
) -> None:
    change(confidence)
    assert status(confidence, 3) is expected


@pytest.mark.parametrize("known", [False, True])
def test_two_contacts_are_not_enough_where_nothing_was_known_before(
    box_model: ObservationModel, known: bool
) -> None:
    """Most objects explain any two contacts somewhere; the third can contradict them."""
    made = Confidence.of(belief(), box_model.scene)
    for contact in (1, 2, 3):
        made.learned(belief(), SEARCHED, contact, contact, in_doubt=False, known=known)
        enough = known or contact >= LEAST
        assert status(made, contact) is (Status.CONVERGED if enough else Status.AMBIGUOUS)


def test_a_belief_that_few_samples_have_searched_is_not_converged(confidence: Confidence) -> None:
    confidence.learned(belief(0.1), 50, 3, 3, in_doubt=False)
    confidence.learned(belief(0.1), SEARCHED - 1, 4, 4, in_doubt=False)
    assert status(confidence, 4) is Status.AMBIGUOUS
    confidence.revisited(belief(0.1), 1)
    assert status(confidence, 4) is Status.CONVERGED


def test_once_contacts_contradict_each_other_more_must_agree(confidence: Confidence) -> None:
    confidence.contradicted(3, 1)
    for contact in range(3, 7):
        remembered = contact - 2  # the refuted ones were dropped
        confidence.learned(belief(), 50, contact, remembered, in_doubt=False)
        enough = remembered >= AGREEING
        assert status(confidence, contact) is (Status.CONVERGED if enough else Status.AMBIGUOUS)


def test_each_time_that_contacts_contradict_each_other_as_many_again_must_agree(
    confidence: Confidence,
) -> None:
    """Of an object of another shape some contacts always agree, and others never do."""
    confidence.contradicted(2, 1)
    confidence.contradicted(3, 2)  # three in all
    for contact, remembered in ((3, AGREEING), (4, 3 * AGREEING - 1), (5, 3 * AGREEING)):
        confidence.learned(belief(), 50, contact, remembered, in_doubt=False)
        enough = remembered >= 3 * AGREEING
        assert status(confidence, contact) is (Status.CONVERGED if enough else Status.AMBIGUOUS)


def test_scans_refuted_that_are_no_contact_count_once(confidence: Confidence) -> None:
    """Silence that moved objects leave behind, and what was known before all contacts."""
    for contact in (3, 4, 5):
        confidence.contradicted(contact)
    confidence.learned(belief(), 50, 5, AGREEING, 1, in_doubt=False)
    assert status(confidence, 5) is Status.CONVERGED


def test_contradictions_before_all_that_is_remembered_count_once_at_most(
    confidence: Confidence,
) -> None:
    """An object that is moved again and again is found each time after as many contacts."""
    confidence.contradicted(3, 2)
    for moved in (10, 20, 30):
        confidence.contradicted(moved, 2)
        confidence.contradicted(moved + 1, 1)  # which leaves the contacts from `moved` + 1 on
        for contact in range(moved + 1, moved + 6):
            agree = contact - moved
            confidence.learned(belief(), 50, contact, agree, moved + 1, in_doubt=False)
            expected = Status.CONVERGED if agree >= AGREEING else Status.AMBIGUOUS
            assert status(confidence, contact) is expected
    confidence.learned(belief(), 50, 40, AGREEING - 1, 38, in_doubt=False)
    assert status(confidence, 40) is Status.AMBIGUOUS


def test_before_any_contact_and_where_blind_nothing_else_counts(confidence: Confidence) -> None:
    confidence.judged(doubt=True)
    assert status(confidence, 0) is Status.SEARCHING
    assert status(confidence, 2, blind=True) is Status.BLIND
