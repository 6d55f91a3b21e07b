"""Presses that were held still, found in the scans of a session as they come.

A press begins when the skin reads something and ends when most of that is gone: foam reads on for
long after a release. Of a press the deepest part is used in which the sensor stood still, and of
that the first second, before the foam gives way further.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from taxeld.arrays import Bools, Floats, Poses
from taxeld.model import se2
from taxeld.pipeline.pipeline import Outcome, Pipeline

STILL_M = 2e-4  # the largest motion of a point of the skin between two scans of a hold
LEAST_SCANS, MOST_SCANS = 4, 20  # scans in a hold
ENDED = 0.25  # share of a press's largest sum: below it the press is over
DEEPER = 1.1  # times what an earlier hold of the same press read: then the later hold is used
THRESHOLDS = 3.0  # times a taxel's own threshold: a lighter touch is no press
WEAK = 0.2  # share of the usual strongest reading: a weaker one is the foam's residue


@dataclass(frozen=True, slots=True)
class Presses:
    """K presses of M taxels."""

    sensor: Poses  # (K, 3) in the world, as the robot states it
    counts: Floats  # (K, M) over baseline, the mean of a hold
    live: Bools  # (K, M)
    robot_m: float  # sd of the robot's error along x and y, the same throughout a press

    def __len__(self) -> int:
        return len(self.sensor)

    def only(self, kept: Bools) -> "Presses":
        """The presses that `kept` (K,) selects."""
        return Presses(self.sensor[kept], self.counts[kept], self.live[kept], self.robot_m)


class PressFinder:
    """Finds the presses of a skin of M taxels, scan by scan."""

    def __init__(self, taxels: int, radius_m: float, robot_m: float) -> None:
        """`robot_m`: as of `Presses`."""
        self._taxels, self._radius_m, self._robot_m = taxels, radius_m, robot_m
        self._scans: list[tuple[Poses, Floats, Bools]] = []  # of the press under way
        self._peak = self._strongest = 0.0  # of that press: sum of all taxels, and of one taxel
        self._held: list[tuple[Poses, Floats, Bools]] = []
        self._unheld: list[float] = []  # strongest reading of each

    def take(self, sensor: Poses, counts: Floats, live: Bools, felt: Bools) -> None:
        """Take a scan: the robot's pose (3,), counts over baseline (M,), and taxels (M,) that are
        live, and that read enough for a press."""
        pressed = np.where(felt, counts, 0.0)
        strength = float(pressed.sum())
        self._peak = max(self._peak, strength)
        if strength < ENDED * self._peak:
            self._end()
        elif self._peak:
            self._strongest = max(self._strongest, float(pressed.max()))
            self._scans.append((sensor, counts.copy(), live))

    def found(self) -> tuple[Presses, int]:
        """The presses that have ended and were held still, and how many were not."""
        sensor, counts, live = ([row[k] for row in self._held] for k in range(3))
        presses = Presses(
            np.reshape(sensor, (-1, 3)),
            np.reshape(counts, (-1, self._taxels)),
            np.reshape(live, (-1, self._taxels)).astype(bool),
            self._robot_m,
        )
        strongest = presses.counts.max(axis=1, initial=0.0)
        least = WEAK * np.median(strongest) if len(presses) else 0.0
        return presses.only(strongest >= least), sum(one >= least for one in self._unheld)

    def _end(self) -> None:
        """The press under way has ended."""
        sensor, counts, live = (np.array(part) for part in zip(*self._scans, strict=True))
        steps = se2.compose(se2.inverse(sensor[:-1]), sensor[1:])
        moved = np.hypot(steps[:, 0], steps[:, 1]) + self._radius_m * np.abs(steps[:, 2]) >= STILL_M
        best, strength = None, 0.0
        for begin, end in pairwise([0, *(1 + np.flatnonzero(moved)), len(sensor)]):
            if end - begin >= LEAST_SCANS:
                hold = slice(begin, min(end, begin + MOST_SCANS))
                # the first scan may have begun on the way in
                mean = counts[hold][1:].mean(axis=0)
                now = float(np.maximum(mean, 0.0).sum())
                if now > strength:
                    alive = np.asarray(live[hold].all(axis=0))
                    best, strength = (sensor[begin], mean, alive), DEEPER * now
        if best is None:
            self._unheld.append(self._strongest)
        else:
            self._held.append(best)
        self._scans, self._peak, self._strongest = [], 0.0, 0.0


class Observer(PressFinder):
    """Collects rest and presses from the outcomes of a pipeline."""

    def __init__(self, pipeline: Pipeline) -> None:
        layout = pipeline.skin.layout
        robot_m = pipeline.config.sensor_pose.sigma_m
        super().__init__(len(layout), layout.radius_m, robot_m)
        self.pipeline = pipeline
        self.is_touched = False  # now or before
        self.idle_s = 0.0  # time for which the skin was left alone at the start
        self.t = 0.0  # of the last scan, Unix seconds
        self._begun_s: float | None = None

    def on_outcome(self, outcome: Outcome) -> None:
        """Take what a scan led to."""
        if outcome.activation is None:
            return
        skin, live, self.t = self.pipeline.skin, outcome.activation.live, outcome.activation.t
        self.is_touched |= skin.touched
        self._begun_s = self.t if self._begun_s is None else self._begun_s
        if not self.is_touched:
            self.idle_s = self.t - self._begun_s
        if outcome.sensor is not None:
            felt = live & (skin.over > THRESHOLDS * skin.threshold)
            self.take(outcome.sensor, skin.over, live, felt)
