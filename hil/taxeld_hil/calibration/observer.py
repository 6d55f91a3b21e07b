"""Follows a pipeline without a calibration: the skin at rest, then presses of the object."""

from dataclasses import replace

from taxeld.config.tables import Config
from taxeld.errors import SetupError
from taxeld.pipeline.pipeline import Outcome, Pipeline
from taxeld_hil.calibration.presses import PressFinder

PRESS_THRESHOLDS = 3.0  # times a taxel's own threshold: a lighter touch is no press


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
    """Collects rest and presses from the outcomes of a pipeline."""

    def __init__(self, pipeline: Pipeline) -> None:
        self.pipeline, self.model = pipeline, pipeline.estimator.model
        layout = pipeline.skin.layout
        self.presses = PressFinder(len(layout), layout.radius_m)
        self.is_touched = False  # now or before
        self.idle_s = 0.0  # time for which the skin was left alone at the start
        self.t = 0.0  # of the last scan, Unix seconds
        self._begun: float | None = None

    def on_outcome(self, outcome: Outcome) -> None:
        """Take what a scan led to."""
        if outcome.activation is None:
            return
        skin, live, self.t = self.pipeline.skin, outcome.activation.live, outcome.activation.t
        self.is_touched |= skin.touched
        self._begun = self.t if self._begun is None else self._begun
        if not self.is_touched:
            self.idle_s = self.t - self._begun
        if outcome.sensor is not None:
            felt = live & (skin.over > PRESS_THRESHOLDS * skin.threshold)
            self.presses.take(outcome.sensor, skin.over, live, felt)
