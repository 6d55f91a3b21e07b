"""What the age of the inputs makes of an estimate."""

from dataclasses import replace

import numpy as np
import pytest

from taxeld.config.tables import FilterConfig
from taxeld.estimator.estimate import Estimate, Status
from taxeld.estimator.estimator import Estimator
from taxeld.model.observation import ObservationModel
from taxeld.pipeline.freshness import Freshness
from taxeld.proposals.analytic import Projection

STALE_S = 0.5


@pytest.fixture(scope="module")
def estimate(disc_model: ObservationModel) -> Estimate:
    first = Estimator(disc_model, Projection(disc_model), FilterConfig()).estimate
    return replace(first, status=Status.AMBIGUOUS, contacts=1)


def test_what_became_of_the_last_scan_decides_until_the_next(estimate: Estimate) -> None:
    inputs = Freshness(STALE_S)
    seen = [inputs.judged(estimate).status]
    for event in (inputs.used, inputs.unused, inputs.used, inputs.starting, inputs.used):
        event()
        seen.append(inputs.judged(estimate).status)
    assert [status.name for status in seen] == [
        "STARTING",
        "AMBIGUOUS",
        "STALE",
        "AMBIGUOUS",
        "STARTING",
        "AMBIGUOUS",
    ]


def test_without_a_scan_for_too_long_everything_is_stale(estimate: Estimate) -> None:
    inputs = Freshness(STALE_S)
    inputs.came(10.0)
    assert inputs.judged(estimate, 10.5).status is Status.STARTING
    assert inputs.judged(estimate, 10.6).status is Status.STALE
    inputs.used()
    assert inputs.is_silent(10.6)
    assert inputs.judged(estimate, 10.6).status is Status.STALE
    assert inputs.judged(estimate).status is Status.AMBIGUOUS  # in a replay time does not pass
    inputs.came(10.6)
    assert inputs.judged(estimate, 11.0) == estimate


@pytest.mark.parametrize("status", Status)
def test_an_estimate_is_valid_with_fresh_inputs_after_a_touch(
    estimate: Estimate, status: Status
) -> None:
    is_valid = Freshness(STALE_S).is_valid
    usable = status.name in ("SEARCHING", "AMBIGUOUS", "CONVERGED")
    assert is_valid(replace(estimate, status=status)) == usable
    assert not is_valid(replace(estimate, status=status, contacts=0))


@pytest.mark.parametrize(
    ("x", "y", "inside"),
    [
        (1.0, 2.0, True),
        (1.69, 1.31, True),
        (1.71, 2.0, False),
        (1.0, 1.29, False),
        (1e9, 2.0, False),
        (float("nan"), 2.0, False),
    ],
)
def test_an_estimate_where_the_object_cannot_be_is_not_valid(
    estimate: Estimate, x: float, y: float, inside: bool
) -> None:
    freshness = Freshness(STALE_S, centre_m=(1.0, 2.0), within_m=0.7)
    there, centre = np.array([x, y, 0.0]), np.array([1.0, 2.0, 0.0])
    assert freshness.is_valid(replace(estimate, map=there, mean=there)) == inside
    assert freshness.is_valid(replace(estimate, map=centre, mean=there)) == inside
    assert freshness.is_valid(replace(estimate, map=there, mean=centre)) == inside
