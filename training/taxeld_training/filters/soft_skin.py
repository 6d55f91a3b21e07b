"""A soft skin between true activations and what is read, as the harness's skins have it.

The harness presses a mesh against points of a cover; here a trial's own activations are pressed in,
so that thousands of trials are affordable: sag spreads from taxel to taxel. The figures are those
of the harness's skins of the same names, [median, 90th percentile] of lognormals (docs/physics.md).
"""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from taxeld.arrays import Bools, Floats
from taxeld.layout.layout import Layout
from taxeld.model.activation import FLOOR
from taxeld.skin.foam import Residue

Pair: TypeAlias = tuple[float, float]
P90 = 1.2815515655446004  # the 90th percentile of a standard normal
FARTHEST = 2.0  # standard deviations: nothing is drawn beyond
ONSET = 0.15  # of full scale: within about so much a taxel's own deviation has risen
TURN = 0.1  # of full scale, of travel back, until the foam is on the other branch of its loop
SIGMAS = 6.0  # of a taxel's noise: less is no touch to a daemon


@dataclass(frozen=True)
class Figures:
    """Of one skin; the defaults are of `typical`. The harness's `[mesh]` explains them."""

    sag_m: Pair = (0.0019, 0.006)
    bend: float = 0.065
    onset: Pair = (0.85, 2.8)
    hysteresis: Pair = (0.015, 0.032)
    residue: Pair = (0.012, 0.03)
    residue_s: float = 1.0
    residue_slow: Pair = (0.008, 0.075)
    residue_slow_s: float = 30.0
    loading_s: float = 0.5
    gain_cv: float = 0.15
    cross_talk: Pair = (0.01, 0.08)
    noise: Pair = (0.0012, 0.00215)  # of full scale


SKINS = {
    "typical": Figures(),
    "poor": Figures(
        sag_m=(0.0048, 0.0048),
        onset=(0.85, 3.2),
        hysteresis=(0.032, 0.032),
        residue=(0.025, 0.025),
        residue_slow=(0.075, 0.075),
        gain_cv=0.19,
        cross_talk=(0.03, 0.03),
        noise=(0.0045, 0.0045),
    ),
}


class SoftSkin:
    """One skin: what its taxels have drawn lasts; what a press draws ends with it."""

    def __init__(
        self, figures: Figures, layout: Layout, gain: Floats, rng: np.random.Generator
    ) -> None:
        """`gain` (M,) of each taxel."""
        m = len(layout)
        self._figures, self._gain, self._rng = figures, gain, rng
        self._apart_m = np.linalg.norm(layout.position_m[:, None] - layout.position_m, axis=-1)
        self._steeper = _drawn(figures.onset, rng.standard_normal(m)) - 1.0
        self._loop = _drawn(figures.hysteresis, rng.standard_normal(m))
        self._noise = _drawn(figures.noise, rng.standard_normal(m))
        normal = rng.standard_normal((m, m))
        share = _drawn(figures.cross_talk, np.tril(normal) + np.tril(normal, -1).T)
        module = layout.uid >> 4
        self._share = np.where(module[:, None] == module, share, 0.0)
        np.fill_diagonal(self._share, 0.0)
        self._own = rng.standard_normal((3, m))  # of sag and both residues
        self._fading_s = np.array([[figures.residue_s], [figures.residue_slow_s]])
        self._left = np.zeros((2, m))
        self._reading, self._receding = np.zeros((2, m))
        self._t = np.inf
        self._foam = Residue(m)
        self.floor, self.residue = np.zeros((2, m))  # of the last activation
        self._draw()

    def read(self, h: Floats, t: float) -> tuple[Floats, Bools]:
        """Activations z (M,), with noise, for true ones h (M,) at t [s]; and which a daemon's rule
        for what foam keeps takes for pressed."""
        if self._reading.any() and not h.any():
            self._draw()
        reading = self._response(self._sagging(h))
        self._receding = np.clip(self._receding - (reading - self._reading) / TURN, 0.0, 1.0)
        target = self._stays * reading
        rate_s = np.where(target > self._left, self._figures.loading_s, self._fading_s)
        self._left += (target - self._left) * -np.expm1(-max(t - self._t, 0.0) / rate_s)
        self._reading, self._t = reading, t
        kept = np.maximum(reading * (1.0 + self._loop * self._receding), self._left.sum(axis=0))
        z = self._coupled(self._gain * kept) + self._noise * self._rng.standard_normal(len(h))
        least = np.maximum(FLOOR, SIGMAS * self._noise)
        self._foam.on_scan(z, least)
        self.floor, self.residue = np.minimum(least + self._foam.level, 1.0), self._foam.level
        return z, self._foam.pressed

    def _draw(self) -> None:
        """Another press."""
        half = np.sqrt(0.5) * (self._own + self._rng.standard_normal((3, 1)))
        pairs = self._figures.sag_m, self._figures.residue, self._figures.residue_slow
        sag_m, *stays = (_drawn(pair, row) for pair, row in zip(pairs, half, strict=True))
        self._spread = np.exp(-self._apart_m / sag_m[:, None])
        self._stays = np.stack(stays)

    def _sagging(self, h: Floats) -> Floats:
        """(M,) with what the pressed taxels pull their neighbours down by."""
        return np.asarray((self._spread * h).max(axis=1))

    def _response(self, h: Floats) -> Floats:
        top = -np.expm1(-1.0 / ONSET)
        rise = (-np.expm1(-h / ONSET) / top - h) / (1.0 / (ONSET * top) - 1.0)
        return np.asarray(h + self._figures.bend * h * (1.0 - h) + self._steeper * rise)

    def _coupled(self, z: Floats) -> Floats:
        """(M,) with each taxel's shares of the other presses on its module."""
        return np.asarray(z + self._share @ z)


def _drawn(pair: Pair, normal: Floats) -> Floats:
    """Values of a lognormal of a median and a 90th percentile, at standard normals of any shape."""
    median, p90 = pair
    rate = np.log(p90 / median) / P90
    return np.asarray(median * np.exp(rate * np.clip(normal, -FARTHEST, FARTHEST)))
