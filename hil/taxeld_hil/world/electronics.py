"""From a taxel's depth to counts: its response, cross-talk within a module, thermal drift.

The response curve is written here and in `taxeld.model.response`, by two formulas: a fault in one
of them then shows as an error of the estimate or of a calibration.
"""

import numpy as np

from taxeld.arrays import Floats
from taxeld.layout.layout import Layout
from taxeld_hil.scenario.mesh_config import MeshConfig, Pair
from taxeld_hil.world.spread import drawn

ONSET = 0.15  # share of full depth within which a taxel's own deviation has risen
LEAST_SLOPE = 0.1  # least slope of a response: a harder press reads more
GRID = np.linspace(0.0, 1.0, 401)


def mean_response(h: Floats, bend: float) -> Floats:
    """The common curve at depths h (any shape), in shares of full scale; 0 → 0 and 1 → 1."""
    within = np.minimum(h, 1.0)
    return np.asarray(h + bend * within * (1.0 - within))


def deviation(h: Floats) -> Floats:
    """How far a response that begins steeper by one lies above the common curve, at depths h (any
    shape): it rises at once and falls slowly; 0 at 0 and from 1 on. In four recordings of an insole
    most taxels differ by this shape."""
    h = np.minimum(h, 1.0)
    rise = -np.expm1(-h / ONSET) / -np.expm1(-1.0 / ONSET) - h
    return np.asarray(rise / (1.0 / (ONSET * -np.expm1(-1.0 / ONSET)) - 1.0))


class Response:
    """Readings of M taxels at a depth, before their gains: a common curve and own onsets."""

    def __init__(self, config: MeshConfig, taxels: int, rng: np.random.Generator) -> None:
        self._bend = config.bend
        onset = drawn(config.onset, rng.standard_normal(taxels))
        room = np.diff(mean_response(GRID, config.bend)) - LEAST_SLOPE * np.diff(GRID)
        turn = np.diff(deviation(GRID))
        least, most = -(room / turn)[turn > 0.0].min(), (room / -turn)[turn < 0.0].min()
        self.steeper = np.clip(onset - 1.0, min(least, 0.0), max(most, 0.0))

    def __call__(self, h: Floats) -> Floats:
        """Readings (…, M) at depths h (…, M), both in shares of full scale."""
        return np.asarray(mean_response(h, self._bend) + self.steeper * deviation(h))


class CrossTalk:
    """The part of other presses on its module that a taxel reads: a share for each pair of taxels.

    They add up, as currents do. So what is read falls while all presses fade, whichever of them
    then is the strongest.
    """

    def __init__(self, layout: Layout, pair: Pair, rng: np.random.Generator) -> None:
        normal = rng.standard_normal((len(layout), len(layout)))
        share = drawn(pair, np.tril(normal) + np.tril(normal, -1).T)
        module = layout.uid >> 4
        self._share = np.where(module[:, None] == module, share, 0.0)
        np.fill_diagonal(self._share, 0.0)

    def add(self, counts: Floats) -> Floats:
        """Counts (M,) of presses with what the others of each module couple into them."""
        return np.asarray(counts + self._share @ counts)


class ThermalDrift:
    """Counts that the temperature adds: one slow sine wave, and each taxel's share in it."""

    def __init__(
        self,
        taxels: int,
        counts_per_min: float,
        period_s: float,
        cv: float,
        rng: np.random.Generator,
    ) -> None:
        self._rate = 2.0 * np.pi / period_s
        self._counts = counts_per_min / 60.0 / self._rate
        self._phase = rng.uniform(-np.pi, np.pi)
        self.share = 1.0 + cv * rng.standard_normal(taxels)

    def counts(self, t: float) -> float:
        """The drift at t [s] of a taxel whose share is 1, and of T0."""
        return float(self._counts * np.sin(self._rate * t + self._phase))
