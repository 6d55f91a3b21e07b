"""The evidence of one scan, whatever the object: each reading's fields, as `explain` needs them."""

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from taxeld.arrays import Bools, Floats, Grid
from taxeld.estimator.anything import Anything
from taxeld.model.noise import Noise
from taxeld.model.observation import Observation, ObservationModel

FAR = 1e30  # standard deviations: no bound


class Kept(IntEnum):
    """Fields kept for each reading."""

    Z = 0
    LEVEL = 1  # the reading, or the floor where it is 0
    ROOT = 2  # 1 / standard deviation of the reading, 0 where not live
    SILENT = 3  # log p(z | h = 0)
    SIGMA2 = 4  # variance of the reading at rest, with what earlier presses may have left
    GAIN2 = 5  # variance of the gain
    SAG = 6  # length of the cover's sag beside the taxel [m]
    MOST = 7  # the same, one standard deviation more
    RESIDUE = 8
    LOW = 9  # lower bound on the reading's excess over the expected [standard deviations]
    HIGH = 10  # upper bound on the reading's excess over the expected [standard deviations]
    LIVE = 11


class Told(NamedTuple):
    """The evidence of one scan, whatever the pose."""

    kept: Grid  # (FIELDS, M)
    anything: float  # log p(scan | whatever was pressed, or nothing)
    untouched: float  # log p(scan | nothing is pressed)
    pressed: int  # number of pressed taxels


class Silence(NamedTuple):
    """The evidence of a silent scan, kept for others with the same taxels and floors."""

    live: Bools
    floor: Floats
    residue: Floats
    noise: Noise
    told: Told


class Reader:
    """Reads the scans of one skin."""

    def __init__(self, model: ObservationModel, noise: Noise) -> None:
        self._noise = noise
        self._anything = Anything(model, noise)
        self._silence: Silence | None = None  # the last silent scan
        self._last: Observation | None = None  # the last scan, with its evidence
        self._told: Told

    def read(self, observation: Observation) -> Told:
        """The evidence of a scan; that of the last one is kept, for other objects."""
        if observation is not self._last:
            self._last, self._told = observation, self._evidence(observation)
        return self._told

    def _evidence(self, observation: Observation) -> Told:
        z, live, before = observation.z, observation.live, self._silence
        floor = np.broadcast_to(observation.floor, len(z))
        residue = np.broadcast_to(observation.residue, len(z))
        noise = observation.noise or self._noise
        if observation.is_contact:
            told = self._read(z, live, floor, residue, noise)
            return told._replace(anything=self._anything.log_density(observation))
        now = live, floor, residue
        if (
            before is None
            or before.noise is not noise
            or not all(map(np.array_equal, now, before[:3]))
        ):
            told = self._read(z, live, floor, residue, noise)
            now = live.copy(), floor.copy(), residue.copy()
            before = self._silence = Silence(*now, noise, told)
        return before.told

    def _read(self, z: Floats, live: Bools, floor: Floats, residue: Floats, noise: Noise) -> Told:
        """Evidence of activations z, live, floor and residue, each (M,)."""
        kept = fields(z, live, floor, residue, noise)
        untouched = float(kept[Kept.SILENT].sum(dtype=np.float64))
        return Told(kept, untouched, untouched, int(np.count_nonzero(z)))


def fields(z: Floats, live: Bools, floor: Floats, residue: Floats, noise: Noise) -> Grid:
    """The fields of activations z (…, M), with live, floor and residue, each (M,) → (FIELDS, …,
    M)."""
    pressed = z > 0.0
    made = np.empty((len(Kept), *z.shape), np.float32)
    made[Kept.Z] = z
    made[Kept.LEVEL] = np.where(pressed, z, floor)
    made[Kept.RESIDUE] = residue
    made[Kept.ROOT] = live / np.sqrt(noise.variance(z) + residue**2)
    made[Kept.SIGMA2] = np.square(noise.sigma) + residue**2
    made[Kept.GAIN2] = np.square(noise.gain_cv)
    made[Kept.SAG] = noise.sag_m
    made[Kept.MOST] = noise.sag_m * np.exp(noise.sag_sd)
    made[Kept.SILENT] = noise.log_density(z, np.zeros_like(z), floor, residue) * live
    made[Kept.LOW] = np.where(z < 1.0, -FAR, 0.0)
    made[Kept.HIGH] = np.where(pressed, FAR, 0.0)
    made[Kept.LIVE] = live
    return made
