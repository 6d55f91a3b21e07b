"""The words found, sure and misleading."""

import math

import pytest

from taxeld.estimator.estimate import SURE
from taxeld_hil import integrity


@pytest.mark.parametrize(
    ("p", "error_mm", "radius_mm", "found", "sure", "misleading"),
    [
        (1.0, 3.0, 5.0, True, True, False),
        (SURE, 5.0, 5.0, True, True, False),  # exactly at its radius
        (1.0, 6.0, 5.0, True, True, True),  # beyond its radius
        (1.0, 10.0, 20.0, False, True, True),  # 10 mm is not under 10 mm
        (1.0, math.nan, 20.0, False, True, True),  # another object
        (0.98, 99.0, 5.0, False, False, False),  # claims nothing
        (math.nan, 99.0, math.nan, False, False, False),  # a filter that publishes no p
    ],
)
def test_what_is_sure_misleads_unless_it_is_found_and_within_its_radius(
    p: float, error_mm: float, radius_mm: float, found: bool, sure: bool, misleading: bool
) -> None:
    assert integrity.is_found(error_mm) == found
    assert integrity.is_sure(p) == sure
    assert integrity.is_misleading(p, error_mm, radius_mm) == misleading
