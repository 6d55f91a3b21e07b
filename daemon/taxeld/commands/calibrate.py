"""`taxeld calibrate`: full scale, gains, response, noise and mount (docs/calibration.md).

A running skin is recorded first (`calibrate_guided`) and then fitted as any session: an idle
minute, then presses of an object that is held fast, each held still for a second.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.commands.calibration_page import write
from taxeld.commands.calibration_result import Heard, Result
from taxeld.commands.hearing import Say, hear
from taxeld.config.tables import Config
from taxeld.errors import SetupError
from taxeld.skin import calibration_search, state
from taxeld.skin.calibration import Calibration
from taxeld.skin.calibration_fit import Fit
from taxeld.skin.calibration_search import Known
from taxeld.source import session

LEAST_IDLE_S = 10.0


def calibrate(directory: Path, config: Config, out: Path, placed: Poses | None, say: Say) -> Result:
    """Fit a session, and write FILE, a text and a picture beside it. `placed` (3,): the object's
    pose in the world; None: the session's own, or else it is found.

    Raises:
        SetupError: the session or what is configured cannot be used, or does not tell enough.
    """
    if not session.has_poses(directory):
        raise SetupError(
            f"{directory / session.POSES}: is missing; a calibration needs the robot's poses, so "
            "record with sensor_pose.endpoint"
        )
    if placed is None:
        placed = _recorded_truth(directory)
    heard = hear(directory, config, say)
    result = fit(heard, config, placed)
    write(result, out, say)
    return result


def fit(heard: Heard, config: Config, placed: Poses | None) -> Result:
    """Raises SetupError where the presses, or what is known beside, do not tell enough."""
    if heard.idle.seconds < LEAST_IDLE_S:
        raise SetupError(
            f"calibrate: the skin was left alone for {heard.idle.seconds:.0f} s at the start, and "
            f"its noise takes {LEAST_IDLE_S:.0f}; touch nothing in the first minute"
        )
    if not len(heard.presses):
        held = f"; {heard.moving} were not held still" if heard.moving else ""
        raise SetupError(f"calibrate: no press was found{held}; press for a second each")
    if placed is None and heard.found is None:
        raise SetupError(
            "calibrate: the object was not found by touch, so its pose must be given: "
            "--object X Y YAW, in metres and radians, in the robot's world"
        )
    known = Known(np.asarray(heard.found if placed is None else placed), given=placed is not None)
    alive = heard.presses.live & ~heard.idle.frozen
    presses = replace(heard.presses, live=alive)
    found, sigma, gain_cv = calibration_search.calibrate(
        heard.model, presses, heard.idle.noise, known
    )
    return Result(_calibration(found, sigma, gain_cv, heard, config), found, heard, known.given)


def _calibration(
    found: Fit, sigma: float, gain_cv: float, heard: Heard, config: Config
) -> Calibration:
    return Calibration(
        t=heard.t,
        digest=state.digest(heard.model.layout),
        object=config.scene.bundle,
        presses=len(heard.presses),
        full_scale_depth_m=config.skin.full_scale_depth_m,
        full_scale_counts=found.full_scale,
        full_scale_sd=found.full_scale_sd,
        bend=found.bend,
        bend_sd=found.bend_sd,
        mount=found.mount,
        mount_sd=found.mount_sd,
        noise_sigma=sigma,
        gain_cv=gain_cv,
        gain=found.gain,
        gain_sd=found.gain_sd,
        onset=found.onset,
        onset_sd=found.onset_sd,
        noise_counts=_rounded(heard.idle.noise),
        frozen=heard.idle.frozen,
    )


def _rounded(noise: Floats) -> Floats:
    """Noise that a reader of whole counts can have: their own rounding at least."""
    return np.asarray(np.maximum(noise, 1.0 / np.sqrt(12.0)))


def _recorded_truth(directory: Path) -> Poses | None:
    """The object's pose that a harness has left in the session; it stands still."""
    path = directory / session.TRUTH
    if not path.exists():
        return None
    rows = session.read_poses(path)
    return np.array(rows[-1][1:]) if rows else None
