"""The scans that are learned from. A scan is read once: what its readings tell is the same for each
object and pose.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Floats, Grid
from taxeld.config.tables import FilterConfig
from taxeld.estimator.background import Background
from taxeld.model.noise import Noise
from taxeld.model.observation import Observation, ObservationModel
from taxeld.model.response import SAG_M, SAG_SD

REMEMBERED = 16  # scans of touches at most
SILENT_MAX = 32  # silent scans at most
ANSWERS = 0.95  # share of presses that a taxel answers, until it is known better
VERSION = 4  # of `scan_arrays` and `SkinState`
OF_SCAN = "number", "size", "link", "sensor", "place_sd_m", "outliers"
OF_NOISE = "sigma", "gain_cv", "sag_m", "sag_sd", "answers"
OF_TAXELS = "z", "live", "floor", "residue", *OF_NOISE

Arrays = dict[str, NDArray[Any]]
Used = tuple[Observation, int]
"""A scan to learn from, and the number of its contact or of the one before."""


class Field(IntEnum):
    """What is told by each reading, as `explain` needs it; explain.c reads the first nine."""

    Z = 0
    LEVEL = 1  # the reading, or the floor where it is 0
    ROOT = 2  # 1 / standard deviation of the reading, 0 where not live
    SILENT = 3  # log p(z | h = 0)
    SIGMA2 = 4  # variance of the reading at rest, with what earlier presses may have left
    GAIN2 = 5  # variance of the gain
    SAG = 6  # length of the cover's sag beside the taxel [m]
    MOST = 7  # the same, one standard deviation more
    QUIET = 8  # probability that the reading is 0 at any depth; 0 where it is not 0
    RESIDUE = 9


@dataclass(frozen=True, slots=True, eq=False)
class ScanEvidence:
    """A scan that was learned from, and its evidence, whatever the object and pose."""

    observation: Observation
    number: int  # of its contact, or of the one before
    is_contact: bool
    fields: Grid  # (FIELDS, M)
    background: float  # log p(scan | whatever was pressed, or nothing)
    untouched: float  # log p(scan | nothing is pressed)

    @property
    def step(self) -> int:
        """Number of the contact that it counts with: silence counts with the next, as the object
        may have moved since the last."""
        return self.number + (not self.is_contact)

    @property
    def remembered(self) -> Observation:
        """The observation in single precision, as it is remembered."""
        return replace(self.observation, z=self.fields[Field.Z].astype(np.float64))


class Reader:
    """Reads the scans of one estimator."""

    def __init__(self, links: Sequence[ObservationModel], noise: Noise) -> None:
        """`links`: the skins; the object does not matter. `noise`: where a scan has none."""
        self._noise = noise
        self._background = [Background(each, noise) for each in links]
        self._silent: ScanEvidence | None = None  # the last silent scan

    def read(self, observation: Observation, number: int = 0) -> ScanEvidence:
        """A scan's evidence; `number`: of its contact, or of the one before."""
        before, is_contact = self._silent, observation.is_contact
        if before is not None and not is_contact and _are_alike(before.observation, observation):
            return replace(before, observation=observation, number=number)
        fields = fields_of(observation.z, observation, observation.noise or self._noise)
        background = untouched = float(fields[Field.SILENT].sum(dtype=np.float64))
        if is_contact:
            background = self._background[observation.link].log_density(observation)
        scan = ScanEvidence(observation, number, is_contact, fields, background, untouched)
        if not is_contact:
            self._silent = scan
        return scan


def until_last_touch(scans: Sequence[ScanEvidence]) -> list[ScanEvidence]:
    """Without the silence after the last contact: the object may be moved before the next."""
    last = max((scan.number for scan in scans if scan.is_contact), default=0)
    return [scan for scan in scans if scan.number < last or scan.is_contact]


def _are_alike(one: Observation, other: Observation) -> bool:
    """Whether two silent scans tell the same."""
    state = ("live", "floor", "residue")
    same = (np.array_equal(getattr(one, name), getattr(other, name)) for name in state)
    return one.noise is other.noise and all(same)


def surplus(scans: Sequence[ScanEvidence]) -> int | None:
    """Which scan to forget after the last one was added, None where there is room: the oldest of
    its kind, and of touches the oldest of the contact with the most scans, because further scans of
    one press tell little."""
    is_contact = scans[-1].is_contact
    alike = [k for k, scan in enumerate(scans) if scan.is_contact == is_contact]
    if len(alike) <= (REMEMBERED if is_contact else SILENT_MAX):
        return None
    numbers = [scans[k].number if is_contact else 0 for k in alike]
    most = max(map(numbers.count, numbers))
    return next(
        k for k, number in zip(alike, numbers, strict=True) if numbers.count(number) == most
    )


def noise_of(config: FilterConfig) -> Noise:
    """Errors of a skin of which no more is known than its kind."""
    return Noise(config.noise_sigma, config.gain_cv, sag_m=SAG_M, sag_sd=SAG_SD, answers=ANSWERS)


def fields_of(z: Floats, like: Observation, noise: Noise) -> Grid:
    """The fields of activations z (…, M), of a skin in the state of an observation → (FIELDS, …,
    M)."""
    live = like.live
    floor, residue = (np.broadcast_to(each, len(live)) for each in (like.floor, like.residue))
    made = np.empty((len(Field), *z.shape), np.float32)
    made[Field.Z] = z
    made[Field.LEVEL] = np.where(z > 0.0, z, floor)
    made[Field.ROOT] = live / np.sqrt(noise.variance(z) + residue**2)
    made[Field.SILENT] = noise.log_density(z, np.zeros_like(z), floor, residue) * live
    made[Field.SIGMA2] = np.square(noise.sigma) + residue**2
    made[Field.GAIN2] = np.square(noise.gain_cv)
    made[Field.SAG] = noise.sag_m
    made[Field.MOST] = noise.sag_m * np.exp(noise.sag_sd)
    made[Field.QUIET] = noise.quiet(z)
    made[Field.RESIDUE] = residue
    return made


def scan_arrays(scans: Sequence[ScanEvidence]) -> Arrays:
    """Scans as arrays (K, …) of single precision, filled up to the most taxels of a link; the noise
    is nan where it is not known."""
    most = max((len(scan.observation.z) for scan in scans), default=0)
    rows = [_row(scan, most) for scan in scans]
    # an array each: a large one would hold the loop up while numpy copies it
    return {name: np.array([row[name] for row in rows]) for name in (*OF_SCAN, *OF_TAXELS)}


def _row(scan: ScanEvidence, most: int) -> Arrays:
    seen, size = scan.observation, len(scan.observation.z)
    noise = seen.noise or Noise(math.nan, outliers=math.nan)
    own = scan.number, size, seen.link, seen.sensor, seen.place_sd_m, noise.outliers
    row = {name: np.asarray(value) for name, value in zip(OF_SCAN, own, strict=True)}
    for name in OF_TAXELS:
        row[name] = np.zeros(most, np.float32)
        row[name][:size] = getattr(noise if name in OF_NOISE else seen, name)
    return row


def scans_of(arrays: Arrays) -> list[Used]:
    """The scans of `scan_arrays`, to be learned again."""
    scans = []
    for k, (size, number) in enumerate(zip(arrays["size"], arrays["number"], strict=True)):
        own: dict[str, Any] = {
            name: arrays[name][k, :size].astype(np.float64) for name in OF_TAXELS
        }
        noise = {name: own.pop(name) for name in OF_NOISE}
        outliers = arrays["outliers"][k].item()
        known = None if math.isnan(outliers) else Noise(outliers=outliers, **noise)
        own["live"] = own["live"] > 0.0
        own |= {name: arrays[name][k].item() for name in ("link", "place_sd_m")}
        scans.append((Observation(arrays["sensor"][k], **own, noise=known), number.item()))
    return scans
