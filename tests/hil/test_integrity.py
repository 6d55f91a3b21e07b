"""The words found, sure and misleading, and the diagram that they make."""

import math

import numpy as np
import pytest

from taxeld.estimator.estimate import SURE
from taxeld_hil import integrity
from taxeld_hil.integrity import EDGES_MM, Stanford


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
    seen = Stanford()
    seen.add(p, error_mm, radius_mm)
    assert (seen.estimates, seen.sure, seen.misleading) == (1, sure, misleading)


def test_a_diagram_counts_each_sure_estimate_once_and_what_is_beyond_its_axes_at_their_ends() -> (
    None
):
    seen = Stanford()
    seen.add([1.0, 1.0, 1.0, 0.5], [1e-6, 1e6, math.nan, 1.0], [1e-6, 1e6, 1.0, 1.0])
    assert seen.counts.sum() == seen.sure == 3
    assert seen.counts[0, 0] == seen.counts[-1, -1] == 1
    (row,) = np.flatnonzero(seen.counts[-1, :-1])
    assert EDGES_MM[row] <= 1.0 < EDGES_MM[row + 1]


def test_ten_millimetres_are_an_edge_of_the_bins_so_that_none_is_half_found() -> None:
    assert (EDGES_MM == integrity.FOUND_MM).sum() == 1


def test_diagrams_add_up_and_come_back_from_their_rows() -> None:
    rng = np.random.default_rng(0)
    drawn = rng.uniform(0.9, 1.0, (2, 50)), *(rng.uniform(0.0, 30.0, (2, 2, 50)))
    parts, whole = [Stanford(), Stanford()], Stanford()
    for k, part in enumerate(parts):
        part.add(*(each[k] for each in drawn))
        whole.add(*(each[k] for each in drawn))
    assert Stanford.of_row(whole.row()) == whole
    assert Stanford.of_rows(part.row() for part in parts) == whole
