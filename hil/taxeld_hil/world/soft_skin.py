"""Parts of a soft skin: what its taxels and presses draw, foam, responses, cross-talk.

What a taxel or a press draws for itself comes from a lognormal that two quantiles give. The
response curve is written here and in `taxeld.model.response`, by two formulas: a fault in one of
them then shows as an error of the estimate or of a calibration.
"""

import numpy as np

from taxeld.arrays import Floats
from taxeld.layout.layout import Layout
from taxeld_hil.scenario.mesh_config import MeshConfig, Pair

P90 = 1.2815515655446004  # the 90th percentile of a standard normal
FARTHEST = 2.0  # standard deviations: nothing is drawn beyond the 2nd and the 98th percentile
TURN = 0.1  # travel back, in full scales, after which the foam is on its other branch
ONSET = 0.15  # share of full depth within which a taxel's own deviation has risen
LEAST_SLOPE = 0.1  # least slope of a response: a harder press reads more
GRID = np.linspace(0.0, 1.0, 401)


def drawn(pair: Pair, normal: Floats | float) -> Floats:
    """Values of a lognormal of a median and a 90th percentile, at standard normals of any shape."""
    median, p90 = pair
    rate = np.log(p90 / median) / P90 if median else 0.0
    return np.asarray(median * np.exp(rate * np.clip(normal, -FARTHEST, FARTHEST)))


class PerPress:
    """A property that is a taxel's own in half of its variance, and in the other half a press's,
    the same for all taxels: the recordings do not tell the two apart, so the halves are assumed."""

    def __init__(self, pair: Pair, taxels: int, rng: np.random.Generator) -> None:
        self._pair, self._rng = pair, rng
        self._own = rng.standard_normal(taxels)
        self.draw()

    def draw(self) -> None:
        """Another press."""
        press = self._rng.standard_normal()
        self.now = drawn(self._pair, np.sqrt(0.5) * (self._own + press))  # (M,)


class Foam:
    """Hysteresis and residue: readings (M,) in shares of full scale, scan by scan.

    Hysteresis: while a press deepens, the reading itself is read; while it recedes, more by the
    taxel's share of it. This loop closes, does not depend on speed, and is zero at 0 (after Dahl's
    model of friction).

    Residue: a share of a press stays when it is over. It is the sum of two parts, one soon gone and
    one long felt, each with the share of this taxel and press. While a part is below its share of
    what is read it grows towards it with the time constant `loading_s`, so a tap leaves less and
    what presses leave adds up, but never beyond the share; else it decays with its own.
    """

    def __init__(self, config: MeshConfig, taxels: int, rng: np.random.Generator) -> None:
        self._loop = drawn(config.hysteresis, rng.standard_normal(taxels))
        pairs = config.residue, config.residue_slow
        self._share = [PerPress(pair, taxels, rng) for pair in pairs]
        self._fading_s = np.array([[config.residue_s], [config.residue_slow_s]])
        self._loading_s = config.loading_s
        self._left = np.zeros((2, taxels))
        self._reading, self._receding = np.zeros((2, taxels))
        self._t = np.inf

    def press(self, reading: Floats, t: float) -> Floats:
        """Readings (M,) of the foam at time t [s] for ideal readings (M,); times do not go back."""
        step = reading - self._reading
        self._receding = np.clip(self._receding - step / TURN, 0.0, 1.0)
        target = np.stack([share.now for share in self._share]) * reading
        rate_s = np.where(target > self._left, self._loading_s, self._fading_s)
        self._left += (target - self._left) * -np.expm1(-max(t - self._t, 0.0) / rate_s)
        self._reading, self._t = reading, t
        held = reading * (1.0 + self._loop * self._receding)
        return np.asarray(np.maximum(held, self._left.sum(axis=0)))

    @property
    def is_felt(self) -> bool:
        """Whether the last scan was of a press, or anything stays of earlier ones."""
        return bool(self._reading.any() or self._left.any())

    def end(self) -> None:
        """A press is over: the next one has shares of its own."""
        for share in self._share:
            share.draw()


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


def cross_talk(layout: Layout, pair: Pair, rng: np.random.Generator) -> Floats:
    """(M, M) the share of a press that each other taxel of its module reads.

    They add up, as currents do. So what is read falls while all presses fade, whichever of them
    then is the strongest.
    """
    normal = rng.standard_normal((len(layout), len(layout)))
    share = drawn(pair, np.tril(normal) + np.tril(normal, -1).T)
    module = layout.uid >> 4
    share[module[:, None] != module] = 0.0
    np.fill_diagonal(share, 0.0)
    return share
