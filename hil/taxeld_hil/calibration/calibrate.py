"""A session becomes a calibration: at least ten seconds untouched, then presses held still.

The fit begins at several mounts, and the likeliest of them is the result. Presses that do not
suffice are refused, in one line with the cure.
"""

from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from taxeld.arrays import Bools, Floats, Index, Poses
from taxeld.commands.replay import open_pipeline, outcomes
from taxeld.config.tables import Config
from taxeld.errors import SetupError
from taxeld.model import se2
from taxeld.model.noise import FLOOR, Noise
from taxeld.model.observation import ObservationModel
from taxeld.model.response import Inverse
from taxeld.skin.calibration import Calibration, skin_digest
from taxeld.source import session
from taxeld_hil.calibration.fit import CalibrationFit, FitResult, Start
from taxeld_hil.calibration.observer import Observed, Observer, uncalibrated
from taxeld_hil.calibration.presses import Presses

LEAST_IDLE_S = 10.0
KNOWN_GAIN_SD = 0.06  # relative: a gain with a larger sd counts as not measured
ROUNDING_SD = 1.0 / np.sqrt(12.0)  # counts: of whole counts, whatever else the noise is
LEAST_PRESSES = 12
LEAST_SIDES = 4  # sides of the skin that must be pressed, of eight
SEARCHED = np.array([0.006, 0.006, np.radians(8.0)])  # largest mounts that are tried: m, m, rad
STEPS = 7  # mounts that are tried along each axis
APART = np.array([0.003, 0.003, np.radians(3.0)])  # mounts that differ by less are one start
STARTS = 3  # fits, of which the likeliest is the result
OBJECT_SD = np.array([0.03, 0.03, 0.3])  # m, m, rad: of an object's pose that is not given
MOST_LEFT = 1.0  # `FitResult.left` of a right model is 0.3 to 0.7, of a wrong one 1.5 and more
KNOWN_MOUNT = np.array([0.0015, 0.0015, np.radians(1.0)])  # largest sd of a mount: m, m, rad
FOLDS = 5  # parts of the presses; each is judged by a fit to all others
SIGMAS = np.geomspace(0.005, 0.12, 14)
GAIN_CVS = np.linspace(0.0, 0.3, 11)


class Result(NamedTuple):
    """A calibration, and its grounds."""

    calibration: Calibration
    fit: FitResult
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
            f"to measure its noise takes {LEAST_IDLE_S:.0f} s; touch nothing in the first minute"
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
    known = Placed(where, given=placed is not None)
    alive = replace(presses, live=presses.live & ~idle.frozen)
    fit, noise = best_fit(observed.model, alive, idle.noise, known)
    value, sd = fit.value, fit.sd
    calibration = Calibration(
        t=observed.t,
        digest=skin_digest(observed.model.layout),
        object=config.scene.names[0],
        presses=len(presses),
        full_scale_depth_m=config.skin.full_scale_depth_m,
        full_scale_counts=float(np.exp(value.log_full[0])),
        full_scale_sd=float(sd.log_full[0]),
        bend=float(value.bend[0]),
        bend_sd=float(sd.bend[0]),
        mount=value.mount,
        mount_sd=sd.mount,
        noise_sigma=float(noise.sigma),
        gain_cv=float(noise.gain_cv),
        gain=np.exp(value.log_gain),
        gain_sd=sd.log_gain,
        onset=value.onset,
        onset_sd=sd.onset,
        noise_counts=np.maximum(idle.noise, ROUNDING_SD),
        frozen=idle.frozen,
    )
    return Result(calibration, fit, observed, known.given)


@dataclass(frozen=True, slots=True)
class Placed:
    """Pose of the object, and whether it is exact."""

    object: Poses  # (3,) in the world
    given: bool


def best_fit(
    model: ObservationModel, presses: Presses, noise: Floats, known: Placed
) -> tuple[FitResult, Noise]:
    """→ the likeliest fit, and the filter's noise under which the presses are likeliest.

    `noise` (M,): sd of a reading at rest [counts].

    Raises:
        SetupError: the presses do not suffice, in one line with the cure.
    """
    _check_presses(model, presses)
    starts = _starts(model, presses, known)
    fits = [CalibrationFit(model, presses, noise, start).run() for start in starts]
    fit = min(fits, key=lambda fit: fit.cost)
    _check_fit(fit, presses, given=known.given)
    return fit, _noise(model, presses, noise, fit)


def sides(model: ObservationModel, presses: Presses) -> Index:
    """(K,) the eighth of a turn of the skin that felt each press."""
    felt = np.where(presses.live, np.maximum(presses.counts, 0.0), 0.0) ** 2
    return _eighth(felt @ model.layout.position_m[:, :2])


def covered(model: ObservationModel) -> Bools:
    """(8,) the eighths of a turn that have taxels."""
    return np.bincount(_eighth(model.layout.position_m[:, :2]), minlength=8) > 0


def _eighth(at: Floats) -> Index:
    """(N,) of points (N, 2); the first eighth is about the x axis."""
    turn = np.arctan2(at[:, 1], at[:, 0]) / (2.0 * np.pi)
    return np.floor((turn + 1.0 / 16.0) % 1.0 * 8.0).astype(np.intp)


def _check_presses(model: ObservationModel, presses: Presses) -> None:
    if len(presses) < LEAST_PRESSES:
        raise SetupError(
            f"calibrate: {len(presses)} presses were held still, and it takes {LEAST_PRESSES}; "
            "press the object more often, and hold each press still for a second"
        )
    felt = np.unique(sides(model, presses))
    if len(felt) < min(LEAST_SIDES, int(np.count_nonzero(covered(model)))):
        raise SetupError(
            f"calibrate: the presses are on {len(felt)} of the skin's sides (eighths of a turn), "
            f"and it takes {LEAST_SIDES}; turn the sensor about its axis between presses"
        )


def _starts(model: ObservationModel, presses: Presses, known: Placed) -> list[Start]:
    """The mounts of a grid that leave least of the readings unexplained, each with the full scale
    that suits it best; none near another."""
    object_sd = np.zeros(3) if known.given else OBJECT_SD
    y = np.where(presses.live, np.maximum(presses.counts, 0.0), 0.0)
    tried: list[tuple[float, Start]] = []
    for mount in product(*(np.linspace(-most, most, STEPS) for most in SEARCHED)):
        h = model.activation(_seen(presses.sensor, np.array(mount), known.object))
        scale = float((h * y).sum() / max((h * h).sum(), 1e-9))
        start = Start(max(scale, 1.0), np.array(mount), known.object, object_sd)
        tried.append((float(np.abs(y - scale * h).sum()), start))
    chosen: list[Start] = []
    for _, start in sorted(tried, key=lambda one: one[0]):
        if all((np.abs(start.mount - other.mount) > APART).any() for other in chosen):
            chosen.append(start)
    return chosen[:STARTS]


def _check_fit(fit: FitResult, presses: Presses, *, given: bool) -> None:
    if fit.left > MOST_LEFT:
        raise SetupError(
            f"calibrate: no mount within {1e3 * SEARCHED[0]:.0f} mm and "
            f"{np.degrees(SEARCHED[2]):.0f}° explains the presses (left over: "
            f"{fit.left / MOST_LEFT:.1f} times what may be); check the bundle, the object's pose "
            "and that it is held fast, and that no modules are swapped (taxeld-hil accept --press)"
        )
    sd = fit.sd.mount
    if (sd > KNOWN_MOUNT).any():
        turn = np.exp(1j * presses.sensor[:, 2])
        turned = np.degrees(np.sqrt(np.mean(np.angle(turn / turn.mean()) ** 2)))
        cure = (
            "press with other sides of the skin"
            if given
            else f"turn the sensor between presses (its yaw differs by {turned:.0f}° now), or give "
            "the object's pose with --object"
        )
        off = f"{1e3 * sd[:2].max():.1f} mm, {np.degrees(sd[2]):.1f}°"
        raise SetupError(f"calibrate: the mount cannot be told (sd {off}); {cure}")


def _noise(model: ObservationModel, presses: Presses, noise: Floats, fit: FitResult) -> Noise:
    """Each press is judged by a fit to other presses: a fit explains its own too well."""
    readings: list[Floats] = []
    expected: list[Floats] = []
    value = fit.value
    start = Start(float(np.exp(value.log_full[0])), value.mount, value.object, np.zeros(3))
    for fold in range(FOLDS):
        left_out = np.arange(len(presses)) % FOLDS == fold
        other = CalibrationFit(model, presses.only(~left_out), noise, start).run().value
        own = np.exp(other.log_full + other.log_gain)
        inverse = Inverse(float(other.bend[0]), other.onset)
        part = presses.only(left_out)
        z = np.array([inverse(row / own) for row in part.counts])
        readings.append(np.where(z < FLOOR, 0.0, z)[part.live])
        seen = _seen(part.sensor, value.mount, value.object)
        expected.append(model.activation(seen)[part.live])
    z, h = np.concatenate(readings), np.concatenate(expected)
    told = (z > 0.0) | (h > 0.0)  # all noises are alike for the other readings
    tried = [Noise(float(sigma), float(cv)) for sigma in SIGMAS for cv in GAIN_CVS]
    return max(tried, key=lambda noise: noise.log_density(z[told], h[told]).sum())


def _seen(sensor: Poses, mount: Poses, placed: Poses) -> Poses:
    """(K, 3) the object in the sensor's frame, from robot's poses (K, 3)."""
    return se2.compose(se2.inverse(se2.compose(sensor, mount)), placed)
