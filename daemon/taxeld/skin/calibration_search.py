"""From presses to a calibration: where the fit begins, what it must know, and what is refused."""

from dataclasses import dataclass, replace

import numpy as np

from taxeld.arrays import Bools, Floats, Index, Poses
from taxeld.errors import SetupError
from taxeld.model import se2
from taxeld.model.activation import FLOOR
from taxeld.model.observation import Noise, ObservationModel
from taxeld.model.response import Inverse
from taxeld.skin.calibration import Scale
from taxeld.skin.calibration_fit import CalibrationFit, Fit, Start
from taxeld.skin.presses import Presses

LEAST_PRESSES = 12
LEAST_SIDES = 4  # of eight, of the skin
SEARCHED = np.array([0.006, 0.006, np.radians(8.0)])  # of the mount, to either side
STEPS = 7  # on each axis of that
APART = np.array([0.003, 0.003, np.radians(3.0)])  # starts that differ by less are one
STARTS = 4  # mounts that are followed
OBJECT_SD = np.array([0.03, 0.03, 0.3])  # of a pose that is not given but found
ROUNDS, LESS = 3, 5.0  # of such starts; a cost that fell by less has not fallen
OBJECT_STARTS = 4  # more starts where it is, by the same random numbers each time
MOST_CHI = 0.8  # of what may be left: 0.3 to 0.6 is, where the model is right, and 1.5 where not
KNOWN_MOUNT = np.array([0.0015, 0.0015, np.radians(1.0)])  # sd: of more it is not known
FOLDS = 5
SIGMAS = np.geomspace(0.005, 0.12, 14)
GAIN_CVS = np.linspace(0.0, 0.3, 11)


@dataclass(frozen=True, slots=True)
class Known:
    """What the user gives: where the object stands, and whether that is exact."""

    object: Poses  # (3,) in the world
    given: bool


def calibrate(
    model: ObservationModel, presses: Presses, noise: Floats, known: Known
) -> tuple[Fit, float, float]:
    """→ the fit, and the noise σ and gain spread that readings keep about what is expected of them.

    `noise` (M,): counts, of a reading at rest.

    Raises:
        SetupError: the presses cannot tell, in one line with the cure.
    """
    _check_presses(model, presses)
    fit = _best(model, presses, noise, known)
    _check_fit(fit, presses, given=known.given)
    sigma, gain_cv = _spread(model, presses, noise, fit)
    return fit, sigma, gain_cv


def sides(model: ObservationModel, presses: Presses) -> Index:
    """(K,) which eighth of the skin each press was felt by."""
    position = model.layout.position_m
    felt = np.where(presses.live, np.maximum(presses.counts, 0.0), 0.0) ** 2
    return _eighth(felt @ position[:, 0], felt @ position[:, 1])


def covered(model: ObservationModel) -> Bools:
    """(8,) which eighths of a turn have taxels."""
    x, y, _ = model.layout.position_m.T
    return np.bincount(_eighth(x, y), minlength=8) > 0


def _eighth(x: Floats, y: Floats) -> Index:
    """The first is about the x axis."""
    turn = np.arctan2(y, x) / (2.0 * np.pi)
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


def _best(model: ObservationModel, presses: Presses, noise: Floats, known: Known) -> Fit:
    """The likeliest fit of several starts; where the object's pose is not given, begun again from
    where it was found until that finds nothing better."""
    best = _best_of(model, presses, noise, known, np.random.default_rng(0))
    for round_ in range(0 if known.given else ROUNDS):
        again = replace(known, object=best.object)
        other = _best_of(model, presses, noise, again, np.random.default_rng(round_ + 1))
        if other.cost > best.cost - LESS:
            break
        best = other
    return best


def _best_of(
    model: ObservationModel,
    presses: Presses,
    noise: Floats,
    known: Known,
    rng: np.random.Generator,
) -> Fit:
    object_sd = np.zeros(3) if known.given else OBJECT_SD
    best: Fit | None = None
    places = [known.object]
    if not known.given:
        places += list(known.object + rng.standard_normal((OBJECT_STARTS, 3)) * APART)
    for place in places:
        first = CalibrationFit(model, presses, noise, Start(place, object_sd, np.zeros(3)))
        for mount in _mounts(first, STARTS if known.given else 2):
            fit = CalibrationFit(model, presses, noise, Start(place, object_sd, mount)).run()
            if best is None or fit.cost < best.cost:
                best = fit
    assert best is not None  # noqa: S101  (there is always a start)
    return best


def _mounts(fit: CalibrationFit, most: int) -> list[Poses]:
    """Mounts to begin with: the best of a grid, none near another."""
    axes = [np.linspace(-w, w, STEPS) for w in SEARCHED]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    chosen: list[Poses] = []
    for k in np.argsort(fit.cost_of(grid), kind="stable"):
        if all((np.abs(grid[k] - other) > APART).any() for other in chosen):
            chosen.append(grid[k])
        if len(chosen) == most:
            break
    return chosen


def _check_fit(fit: Fit, presses: Presses, *, given: bool) -> None:
    if (fit.mount_sd > KNOWN_MOUNT).any():
        off = f"{1e3 * fit.mount_sd[:2].max():.1f} mm, {np.degrees(fit.mount_sd[2]):.1f}°"
        turned = np.degrees(_spread_of_yaw(presses.sensor[:, 2]))
        cure = (
            "press with other sides of the skin"
            if given
            else f"turn the sensor between presses (its yaw differs by {turned:.0f}° now), or give "
            "the object's pose with --object"
        )
        raise SetupError(f"calibrate: the mount cannot be told (sd {off}); {cure}")
    if fit.chi > MOST_CHI:
        raise SetupError(
            f"calibrate: no mount within {1e3 * SEARCHED[0]:.0f} mm and "
            f"{np.degrees(SEARCHED[2]):.0f}° explains the presses (left over: {fit.chi:.1f} times "
            "what may be); check the bundle, the object's pose and that it is held fast, and that "
            "no modules are swapped (taxeld-hil accept --press)"
        )


def _spread_of_yaw(yaw: Floats) -> float:
    """The sd of angles about their mean direction [rad]."""
    middle = np.arctan2(np.sin(yaw).mean(), np.cos(yaw).mean())
    return float(np.sqrt(np.mean(se2.wrap(yaw - middle) ** 2)))


def _spread(
    model: ObservationModel, presses: Presses, noise: Floats, fit: Fit
) -> tuple[float, float]:
    """σ and gain spread under which readings are likeliest, each press judged by a fit to others:
    a fit explains its own presses too well."""
    readings: list[Floats] = []
    expected: list[Floats] = []
    start = Start(fit.object, np.zeros(3), fit.mount)
    for fold in range(FOLDS):
        left_out = np.arange(len(presses)) % FOLDS == fold
        other = CalibrationFit(model, presses.only(~left_out), noise, start).run()
        part = presses.only(left_out)
        scale = Scale.of(other.full_scale * other.gain, Inverse(other.bend, other.onset))
        z = np.array([scale.activation(row) for row in part.counts])
        q = se2.compose(se2.inverse(se2.compose(part.sensor, fit.mount)), fit.object)
        live = part.live
        readings.append(np.where(z < FLOOR, 0.0, z)[live])
        expected.append(model.activation(q)[live])
    z, h = np.concatenate(readings), np.concatenate(expected)
    told: Bools = (z > 0.0) | (h > 0.0)  # the rest is alike under all of them
    tried = [(float(sigma), float(cv)) for sigma in SIGMAS for cv in GAIN_CVS]
    likely = [
        float(Noise(sigma, gain_cv).log_density(z[told], h[told]).sum()) for sigma, gain_cv in tried
    ]
    return tried[int(np.argmax(likely))]
