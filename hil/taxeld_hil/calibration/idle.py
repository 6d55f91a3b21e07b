"""Noise, drift and stuck taxels, from scans of a skin that is left alone."""

from dataclasses import dataclass

import numpy as np

from taxeld.arrays import Bools, Floats

MOST_SCANS = 12_000  # ten minutes at the usual rate; later scans are not used
SD_OF_STEP = 1.4826 / np.sqrt(2.0)  # median size of a change between scans → sd of a reading
COARSE = 3.0  # counts: below, changes are a few whole counts, and their median says little
STILL_SCANS = 400  # a healthy taxel with half a count of noise stood still for 56 scans at most


@dataclass(frozen=True, slots=True)
class Idle:
    """M taxels."""

    seconds: float
    noise: Floats  # (M,) counts, sd of a reading
    drift: Floats  # (M,) counts a minute
    frozen: Bools  # (M,) without a change for STILL_SCANS


def study(t: Floats, counts: Floats) -> Idle:
    """Of N scans at times `t` (N,) [s], counts (N, M), 0 where a taxel did not answer."""
    n, m = counts.shape
    if n < 2:
        return Idle(0.0, np.zeros(m), np.zeros(m), np.zeros(m, dtype=bool))
    minutes = (t - t.mean()) / 60.0
    drift = minutes @ counts / max(float(minutes @ minutes), 1e-12)
    about = (counts - counts.mean(axis=0) - np.outer(minutes, drift)).std(axis=0)
    steps = np.diff(counts, axis=0)
    by_steps = SD_OF_STEP * np.median(np.abs(steps), axis=0)
    changes = np.vstack([np.zeros(m), np.cumsum(steps != 0.0, axis=0)])
    still = (changes[STILL_SCANS:] == changes[:-STILL_SCANS]).any(axis=0)
    return Idle(
        seconds=float(t[-1] - t[0]),
        noise=np.where(by_steps >= COARSE, by_steps, about),
        drift=drift,
        frozen=still & (counts.max(axis=0) > 0.0),
    )
