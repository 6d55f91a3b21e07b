"""Presses that were held still, found in the scans of a session.

A press begins when the skin reads something and ends when most of that is gone: foam reads on for
long after a release. Of a press the deepest part is used in which the sensor stood still, and of
that the first second, before the foam gives way further.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from taxeld.arrays import Bools, Floats, Poses
from taxeld.model import se2

STILL_M = 2e-4  # the largest motion of a point of the skin between two scans of a hold
LEAST_SCANS, MOST_SCANS = 4, 20  # scans in a hold
ENDED = 0.25  # share of a press's largest sum: below it the press is over
DEEPER = 1.1  # times what an earlier hold of the same press read: then the later hold is used
WEAK = 0.2  # share of the usual strongest reading: a weaker one is the foam's residue


@dataclass(frozen=True, slots=True)
class Presses:
    """K presses of M taxels."""

    sensor: Poses  # (K, 3) in the world, as the robot states it
    counts: Floats  # (K, M) over baseline, the mean of a hold
    live: Bools  # (K, M)

    def __len__(self) -> int:
        return len(self.sensor)

    def only(self, kept: Bools) -> "Presses":
        """The presses that `kept` (K,) selects."""
        return Presses(self.sensor[kept], self.counts[kept], self.live[kept])


def find(
    sensor: Poses, counts: Floats, live: Bools, felt: Bools, radius_m: float
) -> tuple[Presses, int]:
    """The presses that were held still, and how many were not.

    Of N scans in the order of time: the robot's poses `sensor` (N, 3), `counts` (N, M) over
    baseline, and which were `live` (N, M) and `felt` (N, M), strong enough for a press; `radius_m`
    of the skin.
    """
    steps = se2.compose(se2.inverse(sensor[:-1]), sensor[1:])
    moved = np.hypot(steps[:, 0], steps[:, 1]) + radius_m * np.abs(steps[:, 2]) >= STILL_M
    pressed = np.where(felt, counts, 0.0)
    held: list[slice] = []
    unheld: list[float] = []
    for press in _touches(pressed.sum(axis=1)):
        hold = _hold(counts, moved, press)
        if hold is None:
            unheld.append(pressed[press].max())
        else:
            held.append(hold)
    shape = len(held), counts.shape[1]
    mean = np.array([_mean(counts, hold) for hold in held]).reshape(shape)
    alive = np.array([live[hold].all(axis=0) for hold in held], dtype=bool).reshape(shape)
    found = Presses(sensor[[hold.start for hold in held]], mean, alive)
    strongest = mean.max(axis=1, initial=0.0)
    least = WEAK * np.median(strongest) if held else 0.0
    return found.only(strongest >= least), sum(one >= least for one in unheld)


def _touches(strength: Floats) -> Iterator[slice]:
    """Scans of each press that has ended, from what was felt in all (N,)."""
    begin, peak = 0, 0.0
    for k, now in enumerate(strength):
        peak = max(peak, now)
        if now < ENDED * peak:
            yield slice(begin, k)
        if now < ENDED * peak or not peak:
            begin, peak = k + 1, 0.0


def _hold(counts: Floats, moved: Bools, press: slice) -> slice | None:
    """The scans of a press, in which the sensor stood still at its deepest."""
    ends = [press.start, *(press.start + 1 + np.flatnonzero(moved[press.start : press.stop - 1]))]
    best, strength = None, 0.0
    for begin, end in zip(ends, [*ends[1:], press.stop], strict=True):
        hold = slice(begin, min(end, begin + MOST_SCANS))
        if end - begin >= LEAST_SCANS:
            now = float(np.maximum(_mean(counts, hold), 0.0).sum())
            if now > strength:
                best, strength = hold, DEEPER * now
    return best


def _mean(counts: Floats, hold: slice) -> Floats:
    """(M,) without the first scan of the hold, which may have begun on the way in."""
    return np.asarray(counts[hold][1:].mean(axis=0))
