"""A skin's layout: places of its taxels, and the turns that leave it unchanged."""

import hashlib
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Floats, Index

TURN_TOLERANCE_M = 1e-4
BLOCK = 64  # taxels compared with all at a time


@dataclass(slots=True)
class Provenance:
    """Facts about a layout from its file, beside its taxels."""

    unit: str = "m"  # m | mm: unit of the coordinates in the file
    missing: int = 0  # entries without a taxel: id −1, and temperatures
    cut: int = 0
    duplicates: int = 0  # taxels left out because their UID came before
    own_normals: bool = True  # whether the file has normals


@dataclass(frozen=True)
class Layout:
    """M taxels on a link that is, for contact, a cylinder about the sensor frame's z axis."""

    name: str
    uid: NDArray[np.int64]  # (M,) SUI << 4 | name, as on the wire
    position_m: NDArray[np.float64]  # (M, 3) in the sensor frame
    normal: NDArray[np.float64]  # (M, 3) unit, outwards
    radius_m: float  # inf: the taxels lie on no cylinder
    frame: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    """(4, 4) rigid transform from the layout file's frame [m] to the sensor frame, which
    `fit.cylinder` defines; a robot that knows the file's frame finds the sensor by it."""
    source: Provenance = field(default_factory=Provenance)
    turned: int = 0  # normals that point inwards in the file
    no_cylinder: str = ""  # why the radius is infinite; empty where it is not

    def __len__(self) -> int:
        return len(self.uid)

    @cached_property
    def digest(self) -> str:
        """16 hex digits that identify the geometry to 10 µm; bundles refer to them."""
        geometry = np.round(np.hstack([self.position_m, self.normal]) * 1e5).astype("<i8")
        return hashlib.sha256(geometry.tobytes()).hexdigest()[:16]

    @cached_property
    def rms_m(self) -> float:
        """Root mean square distance of the taxels from the cylinder [m]; nan without a cylinder."""
        if math.isinf(self.radius_m):
            return math.nan
        radius = np.hypot(self.position_m[:, 0], self.position_m[:, 1])
        return math.sqrt(np.mean((radius - self.radius_m) ** 2))

    @cached_property
    def turns(self) -> NDArray[np.int16]:
        """(n, M) permutations: `z[turns[k]]` is what z becomes when the touch turns by −2πk/n.

        n is the order of the layout's rotation symmetry about z, 1 where it has none.
        """
        turns = [np.arange(len(self), dtype=np.int16)]  # as many turns as taxels, of a ring
        for order in range(len(self), 1, -1):
            match = self._match(2.0 * np.pi / order) if len(self) % order == 0 else None
            if match is not None:
                for _ in range(order - 1):
                    turns.append(match[turns[-1]])
                break
        return np.array(turns)

    @cached_property
    def sector(self) -> NDArray[np.int64]:
        """(M,) the turn that brings each taxel to angle 0."""
        order = len(self.turns)
        angle = np.arctan2(self.position_m[:, 1], self.position_m[:, 0])
        return np.round(angle * order / (2.0 * np.pi)).astype(np.int64) % order

    def apart_m(self, place_m: Floats | None = None) -> Iterator[tuple[Index, Floats]]:
        """Distances of places (n, 3), or of the taxels, from all taxels, some rows (k,) at a time:
        (k, M) [m]. A matrix of all pairs of 5000 taxels would take 200 MB."""
        places = self.position_m if place_m is None else place_m
        for rows in np.split(np.arange(len(places)), range(BLOCK, len(places), BLOCK)):
            x, y, z = places[rows].T[:, :, None] - self.position_m.T[:, None]
            yield rows, np.sqrt(x * x + y * y + z * z)

    def _match(self, angle: float) -> NDArray[np.int16] | None:
        """(M,) for each taxel, the taxel at the place to which it is turned; None if one has
        none."""
        c, s = np.cos(angle), np.sin(angle)
        turned = self.position_m @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        match = np.empty(len(self), dtype=np.int16)
        for rows, gap in self.apart_m(turned):
            if gap.min(axis=1).max() >= TURN_TOLERANCE_M:
                return None
            match[rows] = gap.argmin(axis=1)
        return match if len(np.unique(match)) == len(self) else None
