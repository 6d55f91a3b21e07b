"""From how deep a taxel is pressed to what is read of it: foam, condenser, neighbours, heat."""

import numpy as np
from numpy.typing import NDArray

from taxeld.layout import Layout

Floats = NDArray[np.float64]

TURN_M = 0.0005  # of travel: so far back, and the foam is on the other branch of its loop
NEIGHBOUR = 1.2  # times the least distance between taxels of a module


class Foam:
    """The skin's memory: M taxels' depths in turn → what their condensers close by [m].

    While a press deepens the depth itself is read, while it recedes `hysteresis` more of it: a loop
    that does not depend on speed, closes, and is nothing at no depth (after Dahl's friction). And
    `creep` of a press that is held stays behind when it is gone, and recovers in `creep_s`.
    """

    def __init__(self, taxels: int, hysteresis: float, creep: float, creep_s: float) -> None:
        self._hysteresis, self._creep, self._creep_s = hysteresis, creep, creep_s
        self._depth, self._receding, self._set = np.zeros((3, taxels))
        self._t = np.inf

    def press(self, depth: Floats, t: float) -> Floats:
        """The reading of depths (M,) at time t [s]; times do not go back."""
        step = depth - self._depth
        self._receding = np.clip(self._receding - step / TURN_M, 0.0, 1.0)
        left = np.exp(-max(t - self._t, 0.0) / self._creep_s)
        self._set = self._creep * depth + left * (self._set - self._creep * depth)
        self._depth, self._t = depth, t
        return np.maximum(depth * (1.0 + self._hysteresis * self._receding), self._set)


def condenser(h: Floats, closing: float) -> Floats:
    """What a plate condenser reads of depths h (any shape) in shares of full scale, where its gap
    closes by `closing`: 0 → 0 and 1 → 1, ever steeper between."""
    return h * (1.0 - closing) / (1.0 - closing * np.minimum(h, 1.0))


def coupling(layout: Layout, cross_talk: float) -> Floats:
    """(M, M): each taxel and its nearest neighbours of the same module share `cross_talk` of their
    difference, so that what a module reads in all stays the same."""
    apart = np.linalg.norm(layout.position_m[:, None] - layout.position_m, axis=-1)
    module = layout.uid >> 4
    apart[module[:, None] != module] = np.inf
    np.fill_diagonal(apart, np.inf)
    near = apart < NEIGHBOUR * apart.min(initial=np.inf)
    exchanged = cross_talk * near
    return np.asarray(np.eye(len(layout)) + exchanged - np.diag(exchanged.sum(axis=1)))


class Warmth:
    """What the temperature adds to readings: one slow wave, of which each taxel has its share."""

    def __init__(self, taxels: int, counts_per_min: float, period_s: float, cv: float,
                 rng: np.random.Generator) -> None:  # fmt: skip
        self._rate = 2.0 * np.pi / period_s
        self._counts = counts_per_min / 60.0 / self._rate
        self._phase = rng.uniform(-np.pi, np.pi)
        self.share = 1.0 + cv * rng.standard_normal(taxels)

    def counts(self, t: float) -> float:
        """Of a taxel whose share is 1, and of T0."""
        return float(self._counts * np.sin(self._rate * t + self._phase))
