"""Follows a pipeline for a calibration: the skin at rest, then presses of the object."""

from dataclasses import dataclass, replace

import numpy as np

from taxeld.arrays import Bools, Floats, Poses
from taxeld.config.tables import Config
from taxeld.errors import SetupError
from taxeld.estimator.estimate import Status
from taxeld.model.observation import ObservationModel
from taxeld.pipeline.pipeline import Outcome, Pipeline
from taxeld_hil.calibration import presses
from taxeld_hil.calibration.presses import Presses

PRESS_THRESHOLDS = 3.0  # times a taxel's own threshold: a lighter touch is no press
MOST_SCANS = 12_000  # ten minutes at the usual rate; later scans are not used
SD_OF_STEP = 1.4826 / np.sqrt(2.0)  # median size of a change between scans → sd of a reading
COARSE = 3.0  # counts: below, changes are a few whole counts, and their median says little
STILL_SCANS = 400  # a healthy taxel with half a count of noise stood still for 56 scans at most


@dataclass(frozen=True, slots=True)
class AtRest:
    """Readings of M taxels that nothing touches."""

    seconds: float
    noise: Floats  # (M,) counts, sd of a reading
    drift: Floats  # (M,) counts a minute
    frozen: Bools  # (M,) without a change for STILL_SCANS


def at_rest(t: Floats, counts: Floats) -> AtRest:
    """The rest of N scans at times `t` (N,) [s]; counts (N, M), 0 where a taxel did not answer."""
    n, m = counts.shape
    if n < 2:
        return AtRest(0.0, np.zeros(m), np.zeros(m), np.zeros(m, dtype=bool))
    minutes = (t - t.mean()) / 60.0
    drift = minutes @ counts / max(float(minutes @ minutes), 1e-12)
    about = (counts - counts.mean(axis=0) - np.outer(minutes, drift)).std(axis=0)
    steps = np.diff(counts, axis=0)
    by_steps = SD_OF_STEP * np.median(np.abs(steps), axis=0)
    changes = np.vstack([np.zeros(m), np.cumsum(steps != 0.0, axis=0)])
    still = (changes[STILL_SCANS:] == changes[:-STILL_SCANS]).any(axis=0)
    return AtRest(
        seconds=float(t[-1] - t[0]),
        noise=np.where(by_steps >= COARSE, by_steps, about),
        drift=drift,
        frozen=still & (counts.max(axis=0) > 0.0),
    )


@dataclass(frozen=True, slots=True)
class Observed:
    """All that a calibration is fitted to."""

    model: ObservationModel
    idle: AtRest
    presses: Presses
    unheld: int  # presses that were not held still
    found: Poses | None  # (3,) the object's pose by the filter, if it found one
    t: float  # time of the last scan, Unix seconds


def uncalibrated(config: Config) -> Config:
    """The configuration of a daemon without a calibration.

    Raises:
        SetupError: it does not say which object is pressed.
    """
    if len(config.scene.names) != 1:
        key = "scene.bundles" if config.scene.bundles else "scene.bundle"
        raise SetupError(
            f"{key}: a skin is calibrated by presses of one object: name one scene.bundle"
        )
    return replace(config, skin=replace(config.skin, calibration=""))


class Observer:
    """Collects rest and presses from the outcomes of a pipeline without a calibration."""

    def __init__(self, pipeline: Pipeline) -> None:
        self.pipeline = pipeline
        self.is_touched = False  # now or before
        self._idle: list[tuple[float, Floats]] = []
        self._rows: list[tuple[Poses, Floats, Bools, Bools]] = []
        self._t = np.nan

    @property
    def idle_s(self) -> float:
        """How long the skin was left alone at the start."""
        return self._idle[-1][0] - self._idle[0][0] if self._idle else 0.0

    def on_outcome(self, outcome: Outcome) -> None:
        """Take what a scan led to."""
        if outcome.activation is None:
            return
        skin, self._t = self.pipeline.skin, outcome.activation.t
        self.is_touched |= skin.touched
        if not self.is_touched and len(self._idle) < MOST_SCANS:
            self._idle.append((self._t, skin.counts.astype(np.uint16)))
        live = outcome.activation.live
        felt = live & (skin.over > PRESS_THRESHOLDS * skin.threshold)
        if outcome.sensor is not None and (felt.any() or (self._rows and self._rows[-1][3].any())):
            self._rows.append((outcome.sensor, skin.over.copy(), live, felt))

    def presses(self) -> tuple[Presses, int]:
        """The presses that have ended and were held still, and how many were not."""
        layout = self.pipeline.skin.layout
        n, m = len(self._rows), len(layout)
        sensor, counts, live, felt = zip(*self._rows, strict=True) if n else ((),) * 4
        return presses.find(
            np.array(sensor).reshape(n, 3),
            np.array(counts).reshape(n, m),
            np.array(live, dtype=bool).reshape(n, m),
            np.array(felt, dtype=bool).reshape(n, m),
            layout.radius_m,
        )

    def observed(self) -> Observed:
        """Rest and presses of all scans so far."""
        estimate = self.pipeline.estimate
        sure = estimate.status in (Status.CONVERGED, Status.AMBIGUOUS)
        counts = np.array([row for _, row in self._idle], dtype=np.float64)
        held, unheld = self.presses()
        return Observed(
            self.pipeline.estimator.model,
            at_rest(
                np.array([t for t, _ in self._idle]),
                counts.reshape(-1, len(self.pipeline.skin.layout)),
            ),
            held,
            unheld,
            estimate.map if sure else None,
            float(self._t),
        )
