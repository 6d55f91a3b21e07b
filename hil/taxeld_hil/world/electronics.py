"""From the depth of a press to a reading: foam, condenser, cross-talk, thermal drift."""

import numpy as np

from taxeld.arrays import Floats
from taxeld.layout.layout import Layout

TURN_M = 0.0005  # of travel back, until the foam is on the other branch of its loop
NEIGHBOUR = 1.2  # times the least distance between taxels of a module


class Foam:
    """Hysteresis and creep: depths (M,) of taxels, scan by scan → how far their condensers close.

    While a press deepens, the depth itself is read; while it recedes, more by the share
    `hysteresis`. This loop closes, does not depend on speed, and is zero at depth 0 (after Dahl's
    model of friction). A share `creep` of a held press remains after the release, and decays with
    the time constant `creep_s`.
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
    """The reading of a plate condenser at depths h (any shape), both in shares of full scale, where
    its gap has closed by `closing`. 0 → 0 and 1 → 1, ever steeper between."""
    return h * (1.0 - closing) / (1.0 - closing * np.minimum(h, 1.0))


def coupling(layout: Layout, cross_talk: float) -> Floats:
    """(M, M): each taxel shares `cross_talk` of the difference with its nearest neighbours on the
    same module, so that the sum over a module stays the same."""
    apart = np.linalg.norm(layout.position_m[:, None] - layout.position_m, axis=-1)
    module = layout.uid >> 4
    apart[module[:, None] != module] = np.inf
    np.fill_diagonal(apart, np.inf)
    near = apart < NEIGHBOUR * apart.min(initial=np.inf)
    exchanged = cross_talk * near
    return np.asarray(np.eye(len(layout)) + exchanged - np.diag(exchanged.sum(axis=1)))


class ThermalDrift:
    """What the temperature adds to readings: one slow sine wave, and each taxel's share in it."""

    def __init__(self, taxels: int, counts_per_min: float, period_s: float, cv: float,
                 rng: np.random.Generator) -> None:  # fmt: skip
        self._rate = 2.0 * np.pi / period_s
        self._counts = counts_per_min / 60.0 / self._rate
        self._phase = rng.uniform(-np.pi, np.pi)
        self.share = 1.0 + cv * rng.standard_normal(taxels)

    def counts(self, t: float) -> float:
        """The drift at t [s] of a taxel whose share is 1, and of T0."""
        return float(self._counts * np.sin(self._rate * t + self._phase))
