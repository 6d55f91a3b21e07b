"""A session becomes a calibration: at least ten seconds untouched, then presses held still."""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from taxeld.arrays import Bools, Floats, Index, Poses
from taxeld.commands.replay import open_pipeline, outcomes
from taxeld.config.tables import Config
from taxeld.errors import SetupError
from taxeld.estimator.estimate import Status
from taxeld.layout.layout import Layout
from taxeld.model.noise import FLOOR, Noise
from taxeld.model.observation import ObservationModel
from taxeld.model.response import Inverse
from taxeld.skin.calibration import Calibration, skin_digest
from taxeld.source import session
from taxeld_hil.calibration.fit import SEARCHED, CalibrationFit, FitResult, Start, likeliest, seen
from taxeld_hil.calibration.presses import Observer, Presses
from taxeld_hil.rules import Rule, at_least, require

LEAST_IDLE_S = 10.0
ROUNDING_SD = 1.0 / np.sqrt(12.0)  # counts: of whole counts, whatever else the noise is
KNOWN_GAIN_SD = 0.06  # relative: a gain with a larger sd counts as not measured
LEAST_PRESSES = 12
LEAST_SIDES = 4  # sides of the skin that must be pressed, of eight
MOST_LEFT = 1.0  # `FitResult.left` of a right model is 0.3 to 0.7, of a wrong one 1.5 and more
KNOWN_MOUNT = np.array([0.0015, 0.0015, np.radians(1.0)])  # largest sd of a mount: m, m, rad
# the check: a full scale may be off by that factor, as responses of a skin differ in common by up
# to a third; and a mount by so much [m, m, rad], a fifth of an error that counts as found
CHECKED = 1.6, np.array([0.002, 0.002, np.radians(2.0)])
SURE = 3.0  # sd by which a value must be off, too
FOLDS = 5  # parts of the presses; each is judged by a fit to all others
SIGMAS = np.geomspace(0.005, 0.12, 14)
GAIN_CVS = np.linspace(0.0, 0.3, 11)


class Result(NamedTuple):
    """A calibration, and its grounds."""

    calibration: Calibration
    layout: Layout
    rules: list[Rule]


class Pressed(NamedTuple):
    """The presses of a session, and the fit to them."""

    observer: Observer
    presses: Presses  # of taxels that are not stuck
    noise: Floats  # (M,) sd of a reading at rest [counts]
    stuck: Bools  # (M,)
    fit: FitResult
    rules: list[Rule]


def of_session(directory: Path, config: Config, placed: Poses | None) -> Result:
    """`placed` (3,): the object's pose in the world; None: the session's own, or found by touch.

    Raises:
        SetupError: the session or the configuration cannot be used, or the presses do not suffice.
    """
    found = _pressed(directory, uncalibrated(config), placed, LEAST_IDLE_S)
    observer, presses, noise, stuck, fit, rules = found
    answering = replace(presses, live=presses.live & ~fit.silent)
    model = observer.pipeline.estimator.model
    errors = errors_of(model, answering, noise, fit)
    value, sd, layout = fit.value, fit.sd, model.layout
    calibration = Calibration(
        t=observer.t,
        digest=skin_digest(layout),
        object=config.scene.names[0],
        presses=len(presses),
        full_scale_depth_m=config.skin.full_scale_depth_m,
        full_scale_counts=float(np.exp(value.log_full[0])),
        full_scale_sd=float(sd.log_full[0]),
        bend=float(value.bend[0]),
        bend_sd=float(sd.bend[0]),
        mount=value.mount,
        mount_sd=sd.mount,
        noise_sigma=float(errors.sigma),
        gain_cv=float(errors.gain_cv),
        gain=np.exp(value.log_gain),
        gain_sd=sd.log_gain,
        onset=value.onset,
        onset_sd=sd.onset,
        noise_counts=noise,
        frozen=stuck,
        answers=fit.answers,
    )
    return Result(calibration, layout, [*rules, *_values(calibration)])


def checked(directory: Path, config: Config, placed: Poses | None) -> list[Rule]:
    """Whether the presses of a session agree with the full scale and the mount that its
    configuration, or its calibration, states. `placed` and Raises as of `of_session`."""
    observer, *_, fit, rules = _pressed(directory, config, placed, 0.0)
    known, (full, mount) = observer.pipeline.config.skin.full_scale_counts, CHECKED
    off, sd = float(fit.value.log_full[0] - np.log(known)), float(fit.sd.log_full[0])
    far = np.abs(fit.value.mount) > np.maximum(mount, SURE * fit.sd.mount)
    is_off = abs(off) > max(np.log(full), SURE * sd)
    said, cure = f"{np.exp(off):.2f} of the {known:.0f} counts that are stated", "calibrate again"
    limit, most = f"1/{full:g}..{full:g}, or within {SURE:g} sd", f"± {_pose(mount)}, or so many sd"
    return [
        *rules,
        Rule("check", "full scale", f"{said}, ± {sd:.0%}", limit, not is_off, cure),
        Rule("check", "mount", f"off by {_pose(fit.value.mount)}", most, not far.any(), cure),
    ]


def _pressed(directory: Path, config: Config, placed: Poses | None, least_idle_s: float) -> Pressed:
    """A replay of a session, and the fit to its presses."""
    only_object(config)
    if not session.head(directory)[1].moves:
        raise SetupError(
            f"{directory}: has no robot; a calibration needs the robot's poses, so record with "
            "sensor_pose.endpoint"
        )
    placed = session.truth(directory) if placed is None else placed  # left by a harness
    pipeline = open_pipeline(directory, config)
    observer = Observer(pipeline)
    for outcome in outcomes(directory, pipeline):
        observer.on_outcome(outcome)
    (presses, unheld), idle_s = observer.found(), observer.idle_s
    model, skin, estimate = pipeline.estimator.model, pipeline.skin, pipeline.estimate
    what, cure = "seconds untouched at first", "touch nothing in that time"
    untouched = at_least("rest", what, idle_s, least_idle_s, cure)
    require([untouched, *press_rules(model, presses)], "calibrate")
    if given := placed is not None:
        where = placed
    elif estimate.status in (Status.CONVERGED, Status.AMBIGUOUS):
        where = estimate.map
    else:
        raise SetupError(
            "calibrate: the object was not found by touch, so its pose must be given: "
            "--object X Y YAW, in metres and radians, in the robot's world"
        )
    state = skin.state()
    assert state is not None  # noqa: S101  (the skin was touched)
    noise, stuck = np.maximum(state.noise, ROUNDING_SD), np.zeros(len(state.noise), dtype=bool)
    stuck[skin.faults()["stuck_taxels"]] = True
    presses = replace(presses, live=presses.live & ~stuck)
    fit = fitted(model, presses, noise, where, given=given)
    x, y, yaw = fit.value.object
    by = "given" if given else "found by touch"
    at_rest = f"{np.median(noise):.1f} counts (median), {noise.max():.1f} at most"
    rules = [
        untouched,
        Rule("rest", "noise", at_rest),
        Rule("rest", "stuck", ", ".join(map(str, np.flatnonzero(stuck))) or "none"),
        *press_rules(model, presses),
        Rule("presses", "not held still", f"{unheld}"),
        *fit_rules(fit, presses, given=given),
        Rule("fit", "object", f"x {x:.4f} m, y {y:.4f} m, yaw {yaw:.4f} rad, {by}"),
    ]
    return Pressed(observer, presses, noise, stuck, fit, rules)


def uncalibrated(config: Config) -> Config:
    """The configuration of a daemon without a calibration."""
    return replace(config, skin=replace(config.skin, calibration=""))


def only_object(config: Config) -> str:
    """The name of the object that is pressed.

    Raises:
        SetupError: the configuration does not say which it is.
    """
    if len(config.scene.names) != 1:
        key = "scene.bundles" if config.scene.bundles else "scene.bundle"
        raise SetupError(
            f"{key}: a skin is calibrated by presses of one object: name one scene.bundle"
        )
    return config.scene.names[0]


def fitted(
    model: ObservationModel, presses: Presses, noise: Floats, placed: Poses, *, given: bool
) -> FitResult:
    """The fit to presses of an object at a pose (3,) in the world, exactly where that is `given`;
    `noise` (M,): sd of a reading at rest [counts].

    Raises:
        SetupError: the presses do not suffice.
    """
    require(press_rules(model, presses), "calibrate")
    fit = likeliest(model, presses, noise, placed, given=given)
    require(fit_rules(fit, presses, given=given), "calibrate")
    return fit


def press_rules(model: ObservationModel, presses: Presses) -> list[Rule]:
    """Rules on presses alone."""
    felt, least = len(np.unique(sides(model, presses))), min(LEAST_SIDES, covered(model).sum())
    more = "press the object more often, and hold each press still for a second"
    turn = "turn the sensor about its axis between presses"
    return [
        at_least("presses", "held still", len(presses), LEAST_PRESSES, more),
        at_least("presses", "sides of the skin", felt, least, turn),
    ]


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


def fit_rules(fit: FitResult, presses: Presses, *, given: bool) -> list[Rule]:
    """Rules on a fit to presses of an object whose pose was `given`, or found along."""
    most = f"{1e3 * SEARCHED[0]:.0f} mm and {np.degrees(SEARCHED[2]):.0f}°"
    check = (
        f"no mount within {most} explains the presses: check the bundle, the object's pose, that "
        "it is held fast, and that no modules are swapped (taxeld-hil accept)"
    )
    turn = np.exp(1j * presses.sensor[:, 2])
    turned = np.degrees(np.sqrt(np.mean(np.angle(turn / turn.mean()) ** 2)))
    more = "press with other sides of the skin"
    if not given:
        more = (
            f"turn the sensor between presses (its yaw differs by {turned:.0f}° now), or give the "
            "object's pose with --object"
        )
    sd, left = fit.sd.mount, fit.left / MOST_LEFT
    is_known = bool((sd <= KNOWN_MOUNT).all())
    said, limit = f"± {_pose(sd)}", f"± {_pose(KNOWN_MOUNT)}"
    return [
        Rule("fit", "left over", f"{left:.2f} of what may be", "at most 1", left <= 1.0, check),
        Rule("fit", "mount", f"{_pose(fit.value.mount)} {said}", limit, is_known, more),
    ]


def _pose(q: Poses) -> str:
    return f"({1e3 * q[0]:.2f} mm, {1e3 * q[1]:.2f} mm, {np.degrees(q[2]):.2f}°)"


def _values(c: Calibration) -> list[Rule]:
    """What was measured, without a limit."""
    known = c.gain_sd <= KNOWN_GAIN_SD
    spread = np.std(np.log(c.gain[known])) if known.sum() > 2 else np.nan
    depth_mm, sure = 1e3 * c.full_scale_depth_m, np.median(c.gain_sd[known]) if known.any() else 1.0
    full = f"{c.full_scale_counts:.0f} counts ± {c.full_scale_sd:.1%} at {depth_mm:g} mm"
    gains = f"{known.sum()} of {len(known)} taxels to {sure:.1%} (median), spread {spread:.0%}"
    bend = f"bend {c.bend:.3f} ± {c.bend_sd:.3f}, onset {np.median(c.onset):.2f} (median)"
    noise = f"{c.noise_sigma:.3f} of full scale, and {c.gain_cv:.0%} of a reading"
    return [
        Rule("fit", "full scale", full),
        Rule("fit", "answers", f"{c.answers.mean():.0%} of firm presses (mean)"),
        Rule("fit", "gains", f"{gains}; the others keep the spread of the skin"),
        Rule("fit", "response", bend),
        Rule("fit", "activation noise", noise),
    ]


def errors_of(model: ObservationModel, presses: Presses, noise: Floats, fit: FitResult) -> Noise:
    """The filter's noise under which the presses are likeliest. Each press is judged by a fit to
    other presses: a fit explains its own too well. Its place is as fitted, as the filter has the
    robot's error beside the noise."""
    readings: list[Floats] = []
    expected: list[Floats] = []
    value = fit.value
    off = np.stack([value.x, value.y, 0.0 * value.x], axis=1)
    presses = replace(presses, sensor=presses.sensor + off, robot_m=0.0)
    start = Start(float(np.exp(value.log_full[0])), value.mount, value.object, np.zeros(3))
    for fold in range(FOLDS):
        left_out = np.arange(len(presses)) % FOLDS == fold
        other = CalibrationFit(model, presses.only(~left_out), noise, start).run().value
        own, inverse = np.exp(other.log_full + other.log_gain), Inverse(other.bend[0], other.onset)
        part = presses.only(left_out)
        z = np.array([inverse(row / own) for row in part.counts])
        readings.append(np.where(z < FLOOR, 0.0, z)[part.live])
        there = seen(part.sensor, value.mount, value.object)
        expected.append(model.activation(there)[part.live])
    z, h = np.concatenate(readings), np.concatenate(expected)
    told = (z > 0.0) | (h > 0.0)  # all noises are alike for the other readings
    tried = [Noise(float(sigma), float(cv)) for sigma in SIGMAS for cv in GAIN_CVS]
    return max(tried, key=lambda noise: noise.log_density(z[told], h[told]).sum())
