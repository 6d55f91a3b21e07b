"""Presses that were held, from a stream of scans: what a calibration is fitted to.

A press begins when the skin reads something and ends when most of that is gone; what foam keeps
reads on for long, so nothing waits for silence. Of a press the part is used in which the sensor
stood still at its deepest; one without such a part is counted and left out. The mean is of what was
read in its first second, before the foam gives way further.
"""

from dataclasses import dataclass, field

import numpy as np

from taxeld.arrays import Bools, Floats, Poses
from taxeld.model import se2

STILL_M = 2e-4  # between two scans: a skin point that moved less has not moved
LEAST_SCANS = 4  # of a hold
MOST_SCANS = 20
ENDED = 0.25  # of the most that a press read in all: what is read when it is over is less
DEEPER = 1.1  # times what a hold read: a later one is another stage of the same press
WEAK = 0.2  # of the usual strongest reading: less is no press but what foam has kept


@dataclass(frozen=True, slots=True)
class Presses:
    """K presses of M taxels."""

    sensor: Poses  # (K, 3) in the world, as the robot tells it
    counts: Floats  # (K, M) over baseline, the mean over a hold
    live: Bools  # (K, M)
    t: Floats  # (K,) when each hold began

    def __len__(self) -> int:
        return len(self.sensor)

    def only(self, kept: Bools) -> "Presses":
        """Those that `kept` (K,) names."""
        return Presses(self.sensor[kept], self.counts[kept], self.live[kept], self.t[kept])


@dataclass(slots=True)
class _Hold:
    """Scans in a row with a sensor that stands still."""

    t: float
    sensor: Poses
    live: Bools
    counts: list[Floats] = field(default_factory=list)

    @property
    def mean(self) -> Floats:
        """(M,); the first scan may be of the way in."""
        return np.asarray(np.mean(self.counts[1:], axis=0))

    @property
    def strength(self) -> float:
        return 0.0 if len(self.counts) < LEAST_SCANS else float(np.maximum(self.mean, 0.0).sum())


class PressFinder:
    """Follows presses, scan by scan."""

    def __init__(self, radius_m: float) -> None:
        self._radius_m = radius_m
        self._found: list[_Hold] = []
        self._unheld: list[float] = []  # strongest reading of those that never stood still
        self._peak = self._strongest = 0.0  # counts of the press that is on: in all, of a taxel
        self._now: _Hold | None = None
        self._best: _Hold | None = None
        self._before: Poses | None = None

    def __len__(self) -> int:
        return len(self._found)

    @property
    def moving(self) -> int:
        """Presses in which the sensor never stood still."""
        least = WEAK * np.median([h.mean.max() for h in self._found]) if self._found else 0.0
        return int(np.count_nonzero(np.array(self._unheld) >= least))

    @property
    def pressing(self) -> bool:
        return self._peak > 0.0

    def on_scan(self, t: float, counts: Floats, live: Bools, sensor: Poses, least: Floats) -> bool:
        """Counts over baseline (M,) at the sensor's pose (3,), of which `least` (M,) are a touch;
        → whether a press has ended that is used."""
        before, self._before = self._before, sensor
        felt = np.where(live & (counts > least), counts, 0.0)
        strength = float(felt.sum())
        self._peak = max(self._peak, strength)
        self._strongest = max(self._strongest, float(felt.max()))
        if not self._peak:
            return False
        if strength < ENDED * self._peak:
            return self._end()
        still = before is not None and self._moved_m(before, sensor) < STILL_M
        if not still:
            self._take_hold()
        if self._now is None:
            self._now = _Hold(t, sensor, live)
        if len(self._now.counts) < MOST_SCANS:
            self._now.counts.append(counts.copy())
            self._now.live = self._now.live & live
        return False

    def presses(self, taxels: int) -> Presses:
        """All that have ended; what is weak beside the others is none."""
        held = self._found
        strongest = np.array([h.mean.max() for h in held])
        kept = strongest >= WEAK * np.median(strongest) if held else np.empty(0, dtype=np.bool_)
        return Presses(
            np.array([h.sensor for h in held]).reshape(-1, 3),
            np.array([h.mean for h in held]).reshape(-1, taxels),
            np.array([h.live for h in held], dtype=np.bool_).reshape(-1, taxels),
            np.array([h.t for h in held]),
        ).only(kept)

    def _take_hold(self) -> None:
        now, best, self._now = self._now, self._best, None
        if now is not None and now.strength > (DEEPER * best.strength if best else 0.0):
            self._best = now

    def _end(self) -> bool:
        self._take_hold()
        best, strongest = self._best, self._strongest
        self._best, self._peak, self._strongest = None, 0.0, 0.0
        if best is None:
            self._unheld.append(strongest)
            return False
        self._found.append(best)
        return True

    def _moved_m(self, a: Poses, b: Poses) -> float:
        gap = se2.compose(se2.inverse(a), b)
        return float(np.hypot(gap[0], gap[1]) + self._radius_m * abs(gap[2]))
