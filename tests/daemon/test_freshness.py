"""Whether an estimate is valid, and the reason and the cure where it is not."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from taxeld.config.tables import FilterConfig
from taxeld.estimator.estimate import Estimate, Hypotheses, Status
from taxeld.estimator.estimator import Estimator
from taxeld.model.observation import ObservationModel
from taxeld.pipeline.freshness import CURES, LEAST_P, Freshness, LinkInputs, Why
from taxeld.proposals.analytic import Projection

STALE_S = 0.5
WIDTH = 72  # characters that a terminal has for a reason


@pytest.fixture(scope="module")
def estimate(disc_model: ObservationModel) -> Estimate:
    first = Estimator(disc_model, Projection(disc_model), FilterConfig()).estimate
    return replace(first, status=Status.AMBIGUOUS, contacts=1, p=0.5)


def used(
    centre_m: tuple[float, float] = (0.0, 0.0), half_width_m: float = np.inf, last: Why = Why.VALID
) -> Freshness:
    """Of an object that reaches 0.1 m, after a scan that was used."""
    return Freshness([LinkInputs(last)], STALE_S, centre_m, half_width_m, reach_m=0.1)


def test_what_became_of_the_last_scan_decides_until_the_next(estimate: Estimate) -> None:
    inputs = used(last=Why.STARTING)
    seen = [(inputs.judged(estimate).status.name, inputs.why(estimate).name)]
    for inputs.links[0].last in (
        Why.VALID,
        Why.NO_POSE,
        Why.SCANS_MISTIMED,
        Why.VALID,
        Why.STARTING,
    ):
        seen.append((inputs.judged(estimate).status.name, inputs.why(estimate).name))
    assert seen == [
        ("STARTING", "STARTING"),
        ("AMBIGUOUS", "VALID"),
        ("STALE", "NO_POSE"),
        ("STALE", "SCANS_MISTIMED"),
        ("AMBIGUOUS", "VALID"),
        ("STARTING", "STARTING"),
    ]


def test_without_a_scan_for_too_long_everything_is_stale(estimate: Estimate) -> None:
    inputs = used(last=Why.STARTING)
    inputs.came(10.0)
    assert inputs.judged(estimate, 10.5).status is Status.STARTING
    assert inputs.judged(estimate, 10.6).status is Status.STALE
    assert inputs.why(estimate, 10.6) is Why.NO_SCAN
    inputs.links[0].last = Why.VALID
    assert inputs.judged(estimate, 10.6).status is Status.STALE
    assert inputs.judged(estimate).status is Status.AMBIGUOUS  # in a replay time does not pass
    inputs.came(10.6)
    assert inputs.judged(estimate, 11.0) == estimate
    assert inputs.why(estimate, 11.0) is Why.VALID


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({}, Why.VALID),
        ({"status": Status.SEARCHING, "p": LEAST_P}, Why.VALID),
        ({"status": Status.CONVERGED}, Why.VALID),
        ({"contacts": 0}, Why.UNTOUCHED),
        ({"contacts": 0, "status": Status.BLIND}, Why.BLIND),
        ({"status": Status.INCONSISTENT}, Why.INCONSISTENT),
        ({"p": LEAST_P - 1e-9}, Why.VAGUE),
        ({"p": np.nan}, Why.VAGUE),
        ({"p": 0.0, "contacts": 0}, Why.UNTOUCHED),
        ({"p": 0.0, "status": Status.INCONSISTENT}, Why.INCONSISTENT),
    ],
)
def test_an_estimate_without_a_touch_or_with_less_probability_than_one_leaves_is_not_valid(
    estimate: Estimate, changes: dict[str, Any], why: Why
) -> None:
    assert used().why(replace(estimate, **changes)) is why


@pytest.mark.parametrize(
    ("x", "y", "inside"),
    [
        (1.0, 2.0, True),
        (1.69, 1.31, True),
        (1.71, 2.0, False),
        (1.0, 1.29, False),
        (1e9, 2.0, False),
        (np.nan, 2.0, False),
    ],
)
def test_an_estimate_where_the_object_cannot_be_is_not_valid_and_names_the_keys(
    estimate: Estimate, x: float, y: float, inside: bool
) -> None:
    inputs, why = used((1.0, 2.0), 0.6), Why.VALID if inside else Why.OUTSIDE
    there, centre = np.array([x, y, 0.0]), np.array([1.0, 2.0, 0.0])
    for places in ((there, there), (centre, there), (there, centre)):
        assert inputs.why(replace(estimate, map=places[0], mean=places[1])) is why
    said = inputs.sentence(Why.OUTSIDE, replace(estimate, map=there))
    assert said.startswith("outside filter.centre_m ± filter.half_width_m: ")
    assert said.endswith(f" x {x:.3f} m, y {y:.3f} m; these are [1, 2] ± 0.6 m)")


def test_each_reason_has_a_cure_that_fits_a_terminal(estimate: Estimate) -> None:
    for why in Why:
        assert bool(used().sentence(why, estimate)) == (why is not Why.VALID)
        assert len(CURES[why]) <= WIDTH
    assert used().sentence(Why.NO_POSE, estimate, "no pose comes").endswith(" (no pose comes)")
    doubted = replace(estimate, p=0.0312, hypotheses=Hypotheses(0.09, 0.71, 0.2))
    assert used().sentence(Why.VAGUE, doubted).endswith(" (it is 3.1%)")
    likelier = used().sentence(Why.INCONSISTENT, doubted)
    assert likelier.endswith(" (stands 9%, moved 71%, other 20%)")
