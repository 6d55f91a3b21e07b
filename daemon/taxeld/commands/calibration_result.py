"""What a calibration rests on, as the command hands it from fit to file, text and picture."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from taxeld.arrays import Bools, Poses
from taxeld.model.observation import ObservationModel
from taxeld.skin.calibration import Calibration
from taxeld.skin.calibration_fit import Fit
from taxeld.skin.idle_study import IdleFacts
from taxeld.skin.presses import Presses

TOLD_GAIN_SD = 0.06  # relative: a gain that is known less well is told as not known


@dataclass(frozen=True, slots=True)
class Heard:
    """What a session holds of a skin, an object and a robot."""

    model: ObservationModel
    idle: IdleFacts
    presses: Presses
    moving: int  # presses that were not held still
    found: Poses | None  # (3,) where the estimator found the object, if it did
    t: float  # when it ended, Unix


class Result(NamedTuple):
    """A calibration, and what it rests on."""

    calibration: Calibration
    fit: Fit
    heard: Heard
    given: bool  # whether the object's pose was

    @property
    def known(self) -> Bools:
        """(M,) taxels whose own gain was measured."""
        return np.asarray(self.calibration.gain_sd <= TOLD_GAIN_SD)
