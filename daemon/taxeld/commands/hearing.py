"""What a calibration is made of, from a session or as it comes: an idle minute, then presses."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from taxeld.commands.calibration_result import Heard
from taxeld.commands.replay import open_pipeline, outcomes
from taxeld.config.tables import Config
from taxeld.estimator.estimate import Status
from taxeld.pipeline.outcome import Outcome
from taxeld.pipeline.pipeline import Pipeline
from taxeld.skin.idle_study import IdleStudy
from taxeld.skin.presses import Presses, PressFinder

PRESS_THRESHOLDS = 3.0  # times a taxel's own: lighter is no press to calibrate by

Say = Callable[[str], None]


def hear(directory: Path, config: Config, say: Say) -> Heard:
    """A session, as the daemon would without a calibration. Raises SetupError."""
    pipeline = open_pipeline(directory, uncalibrated(config))
    hearing = Hearing(pipeline)
    for outcome in outcomes(directory, pipeline):
        if hearing.on_outcome(outcome):
            say(f"press {len(hearing)}")
    return hearing.heard()


def uncalibrated(config: Config) -> Config:
    """The configuration of a daemon that uses no calibration."""
    return replace(config, skin=replace(config.skin, calibration=""))


class Hearing:
    """Follows a pipeline: the idle minute, then the presses."""

    def __init__(self, pipeline: Pipeline) -> None:
        """Of a pipeline without a calibration."""
        self.idle = IdleStudy()
        self._pipeline = pipeline
        self._finder = PressFinder(pipeline.skin.layout.radius_m)
        self._touched_t = self._t = np.nan  # of the first touch, and of the last scan

    def __len__(self) -> int:
        """Presses that have ended and can be used."""
        return len(self._finder)

    @property
    def is_touched(self) -> bool:
        """Whether anything was, ever."""
        return not np.isnan(self._touched_t)

    @property
    def moving(self) -> int:
        """Presses that were not held still."""
        return self._finder.moving

    @property
    def presses(self) -> Presses:
        return self._finder.presses(len(self._pipeline.skin.layout))

    def on_outcome(self, outcome: Outcome) -> bool:
        """What a scan led to; → whether a press has ended that can be used."""
        if outcome.activation is None:
            return False
        skin, self._t = self._pipeline.skin, outcome.activation.t
        if not self.is_touched:
            self.idle.on_scan(self._t, skin.counts)
            if skin.touched:
                self._touched_t = self._t
        if outcome.sensor is None:
            return False
        least = PRESS_THRESHOLDS * skin.threshold
        return self._finder.on_scan(
            self._t, skin.over, outcome.activation.live, outcome.sensor, least
        )

    def heard(self) -> Heard:
        """All of it."""
        estimate = self._pipeline.estimate
        sure = estimate.status in (Status.CONVERGED, Status.AMBIGUOUS)
        taxels = len(self._pipeline.skin.layout)
        return Heard(
            self._pipeline.estimator.model,
            self.idle.facts(taxels, self._touched_t if self.is_touched else np.inf),
            self.presses,
            self.moving,
            estimate.map if sure else None,
            float(self._t),
        )
