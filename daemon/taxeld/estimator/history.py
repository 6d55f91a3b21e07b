"""The scans that were learned from, so that another estimator can learn from them again."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taxeld.estimator.mixture import REMEMBERED, SILENT_MAX
from taxeld.model.noise import Noise
from taxeld.model.observation import Observation

VERSION = 3  # of `scan_arrays` and `SkinState`
OF_NOISE = "sigma", "gain_cv", "sag_m", "sag_sd"
OF_TAXELS = "z", "live", "floor", "residue", *OF_NOISE
MOVED = 0.05  # probability that the object was moved while no daemon ran

Arrays = dict[str, NDArray[Any]]
Used = tuple[Observation, int]
"""A scan that was learned from, and the number of its contact or of the one before."""


@dataclass(slots=True)
class History:
    """As many scans as a memory has."""

    scans: Sequence[Used] = ()
    changes: int = field(default=0)

    def add(self, observation: Observation, number: int) -> None:
        """Of too many scans of its kind the oldest goes, of the contact with the most scans."""
        self.changes += 1
        scans = [*self.scans, (observation, number)]
        of = [i for i, (scan, _) in enumerate(scans) if scan.is_contact == observation.is_contact]
        if len(of) > (REMEMBERED if observation.is_contact else SILENT_MAX):
            numbers = [scans[i][1] for i in of]
            most = max(map(numbers.count, numbers)) if observation.is_contact else 0
            del scans[next(i for i in of if numbers.count(scans[i][1]) >= most)]
        self.scans = scans

    def kept(self) -> list[Used]:
        """Without the silence after the last contact: the object may be moved before the next."""
        last = max((number for scan, number in self.scans if scan.is_contact), default=0)
        return [used for used in self.scans if used[1] < last or used[0].is_contact]


def scan_arrays(scans: Sequence[Used]) -> Arrays:
    """Scans as arrays (K, …) of single precision, filled up to the most taxels of a link; the noise
    is nan where it is not known."""
    most = max((len(scan.z) for scan, _ in scans), default=0)
    # an array each: a large one would hold the loop up while numpy copies it
    found: Arrays = {name: np.zeros((len(scans), most), np.float32) for name in OF_TAXELS}
    found["number"] = np.array([number for _, number in scans], np.int64)
    found |= {name: np.zeros(len(scans), np.int64) for name in ("size", "link")}
    found |= {"sensor": np.zeros((len(scans), 3))}
    found |= {name: np.zeros(len(scans)) for name in ("place_sd_m", "outliers")}
    for k, (scan, _) in enumerate(scans):
        noise, size = scan.noise or Noise(math.nan, outliers=math.nan), len(scan.z)
        found["size"][k], found["link"][k], found["sensor"][k] = size, scan.link, scan.sensor
        found["place_sd_m"][k], found["outliers"][k] = scan.place_sd_m, noise.outliers
        for name in OF_TAXELS:
            found[name][k, :size] = getattr(noise if name in OF_NOISE else scan, name)
    return found


def scans_of(arrays: Arrays) -> list[Used]:
    """The scans of `scan_arrays`."""
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
