"""A session becomes a calibration: at least ten seconds untouched, then presses held still."""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from taxeld.arrays import Bools, Poses
from taxeld.commands.replay import open_pipeline, outcomes
from taxeld.config.tables import Config
from taxeld.errors import SetupError
from taxeld.skin import state
from taxeld.skin.calibration import Calibration
from taxeld.source import session
from taxeld_hil.calibration import search
from taxeld_hil.calibration.fit import Fit
from taxeld_hil.calibration.observer import Observed, Observer, uncalibrated

LEAST_IDLE_S = 10.0
KNOWN_GAIN_SD = 0.06  # relative: a gain with a larger sd counts as not measured
ROUNDING_SD = 1.0 / np.sqrt(12.0)  # counts: of whole counts, whatever else the noise is


class Result(NamedTuple):
    """A calibration, and its grounds."""

    calibration: Calibration
    fit: Fit
    observed: Observed
    given: bool  # whether the object's pose was given

    @property
    def known(self) -> Bools:
        """(M,) taxels whose own gain was measured."""
        return np.asarray(self.calibration.gain_sd <= KNOWN_GAIN_SD)


def of_session(directory: Path, config: Config, placed: Poses | None) -> Result:
    """`placed` (3,): the object's pose in the world; None: the session's own, or found by touch.

    Raises:
        SetupError: the session or the configuration cannot be used, or the presses do not suffice.
    """
    if not session.has_poses(directory):
        raise SetupError(
            f"{directory / session.POSES}: is missing; a calibration needs the robot's poses, so "
            "record with sensor_pose.endpoint"
        )
    truth = directory / session.TRUTH  # left by a harness
    if placed is None and truth.exists():
        rows = session.read_poses(truth)
        placed = np.array(rows[-1][1:]) if rows else None
    observer = Observer(open_pipeline(directory, uncalibrated(config)))
    for outcome in outcomes(directory, observer.pipeline):
        observer.on_outcome(outcome)
    return fitted(observer.observed(), config, placed)


def fitted(observed: Observed, config: Config, placed: Poses | None) -> Result:
    """`placed` (3,): the object's pose in the world; None: as it was found by touch.

    Raises:
        SetupError: the presses do not suffice, or the object's pose is not known.
    """
    idle, presses = observed.idle, observed.presses
    if idle.seconds < LEAST_IDLE_S:
        raise SetupError(
            f"calibrate: the skin was left alone for {idle.seconds:.0f} s at the start, and "
            f"its noise takes {LEAST_IDLE_S:.0f}; touch nothing in the first minute"
        )
    if not len(presses):
        held = f"; {observed.unheld} were not held still" if observed.unheld else ""
        raise SetupError(f"calibrate: no press was found{held}; press for a second each")
    where = observed.found if placed is None else placed
    if where is None:
        raise SetupError(
            "calibrate: the object was not found by touch, so its pose must be given: "
            "--object X Y YAW, in metres and radians, in the robot's world"
        )
    known = search.Known(where, given=placed is not None)
    alive = replace(presses, live=presses.live & ~idle.frozen)
    fit, noise = search.calibrate(observed.model, alive, idle.noise, known)
    value, sd = fit.value, fit.sd
    calibration = Calibration(
        t=observed.t,
        digest=state.digest(observed.model.layout),
        object=config.scene.bundle,
        presses=len(presses),
        full_scale_depth_m=config.skin.full_scale_depth_m,
        full_scale_counts=float(np.exp(value.log_full[0])),
        full_scale_sd=float(sd.log_full[0]),
        bend=float(value.bend[0]),
        bend_sd=float(sd.bend[0]),
        mount=value.mount,
        mount_sd=sd.mount,
        noise_sigma=noise.sigma,
        gain_cv=noise.gain_cv,
        gain=np.exp(value.log_gain),
        gain_sd=sd.log_gain,
        onset=value.onset,
        onset_sd=sd.onset,
        noise_counts=np.maximum(idle.noise, ROUNDING_SD),
        frozen=idle.frozen,
    )
    return Result(calibration, fit, observed, known.given)
