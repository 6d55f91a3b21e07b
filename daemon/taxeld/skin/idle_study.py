"""What a skin reads while it is left alone: noise, drift, and taxels that never change."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Bools, Floats

MOST_SCANS = 12_000  # ten minutes at the usual rate; of more the first are used
SD_OF_STEP = 1.4826 / np.sqrt(2.0)  # median size of a scan's change → sd of a reading
COARSE = 3.0  # counts: below, the steps are whole counts, and their median tells little
# a healthy taxel with half a count of noise stood still for 56 scans at most
STILL_SCANS = 400


@dataclass(frozen=True, slots=True)
class IdleFacts:
    """M taxels."""

    scans: int
    seconds: float
    noise: Floats  # (M,) counts, sd of a reading
    drift: Floats  # (M,) counts a minute
    still: NDArray[np.int64]  # (M,) scans in a row without a count of change, at most
    frozen: Bools  # (M,)


class IdleStudy:
    """Takes scans until something is touched."""

    def __init__(self) -> None:
        self._t: list[float] = []
        self._counts: list[NDArray[np.uint16]] = []

    @property
    def seconds(self) -> float:
        return self._t[-1] - self._t[0] if self._t else 0.0

    def on_scan(self, t: float, counts: Floats) -> None:
        """Counts (M,), 0 where a taxel did not answer."""
        if len(self._t) < MOST_SCANS:
            self._t.append(t)
            self._counts.append(counts.astype(np.uint16))

    def facts(self, taxels: int, until: float) -> IdleFacts:
        """Of the scans before the time `until`."""
        counts = np.array(self._counts, dtype=np.float64).reshape(-1, taxels)
        t = np.array(self._t)
        counts, t = counts[t < until], t[t < until]
        if len(t) < 2:
            none = np.zeros(taxels)
            return IdleFacts(len(t), 0.0, none, none, none.astype(np.int64), none > 0.0)
        minutes = (t - t.mean()) / 60.0
        drift = minutes @ counts / max(float(minutes @ minutes), 1e-12)
        steps = SD_OF_STEP * np.median(np.abs(np.diff(counts, axis=0)), axis=0)
        about = (counts - counts.mean(axis=0) - np.outer(minutes, drift)).std(axis=0)
        still = _longest(np.diff(counts, axis=0) == 0.0)
        return IdleFacts(
            scans=len(t),
            seconds=float(t[-1] - t[0]),
            noise=np.where(steps >= COARSE, steps, about),
            drift=drift,
            still=still,
            frozen=(still >= STILL_SCANS) & (counts.max(axis=0) > 0.0),
        )


def _longest(same: Bools) -> NDArray[np.int64]:
    """(M,) the longest run of truth in each column of (N, M)."""
    run = np.zeros(same.shape[1], dtype=np.int64)
    longest = run.copy()
    for row in same:
        run = np.where(row, run + 1, 0)
        longest = np.maximum(longest, run)
    return longest
