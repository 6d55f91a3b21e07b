"""A skin's layout: where its taxels are, and which turns leave it unchanged."""

import hashlib
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from taxeld.errors import SetupError

TAXELS_PER_MODULE = 10  # a generated cylinder's wiring; a real CySkin triangle carries ten as well
MAX_TAXELS = 248 * TAXELS_PER_MODULE  # modules an IHB can address

CYLINDER_KEYS = {"rows": int, "columns": int, "radius_m": float, "pitch_m": float}


@dataclass(frozen=True)
class Layout:
    """M taxels on a link that is, for contact, a cylinder about the sensor frame's z axis."""

    name: str
    uid: NDArray[np.int64]  # (M,) SUI << 4 | name, as on the wire
    position_m: NDArray[np.float64]  # (M, 3) in the sensor frame
    normal: NDArray[np.float64]  # (M, 3) unit, outwards
    radius_m: float

    def __len__(self) -> int:
        return len(self.uid)

    @cached_property
    def digest(self) -> str:
        """16 hex digits that name the geometry (to 10 µm), for bundles to refer to."""
        geometry = np.round(np.hstack([self.position_m, self.normal]) * 1e5).astype("<i8")
        return hashlib.sha256(geometry.tobytes()).hexdigest()[:16]

    @cached_property
    def turns(self) -> NDArray[np.int64]:
        """(n, M) permutations: `z[turns[k]]` is what z becomes when the touch turns by −2πk/n.

        n is the order of the layout's rotation symmetry about z, 1 where it has none.
        """
        order, taxels = 1, np.arange(len(self))
        for n in range(len(self), 1, -1):
            if len(self) % n == 0 and self._match(2.0 * np.pi / n) is not None:
                order = n
                break
        turns = [taxels]
        for k in range(1, order):
            match = self._match(2.0 * np.pi * k / order)
            assert match is not None  # noqa: S101  (a power of a symmetry is one)
            turns.append(match)
        return np.array(turns)

    @cached_property
    def sector(self) -> NDArray[np.int64]:
        """(M,) the turn that brings each taxel to angle 0."""
        order = len(self.turns)
        angle = np.arctan2(self.position_m[:, 1], self.position_m[:, 0])
        return np.round(angle * order / (2.0 * np.pi)).astype(np.int64) % order

    def _match(self, angle: float, tolerance_m: float = 1e-4) -> NDArray[np.int64] | None:
        """For each taxel, the one that lies where it comes to when turned; None if one is not."""
        c, s = np.cos(angle), np.sin(angle)
        turned = self.position_m @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        gap = np.linalg.norm(turned[:, None] - self.position_m[None], axis=-1)
        match = gap.argmin(axis=1)
        unique = len(set(match.tolist())) == len(self)
        return match if unique and gap.min(axis=1).max() < tolerance_m else None


def cylinder(rows: int, columns: int, radius_m: float, pitch_m: float) -> Layout:
    """A generated cylinder: row by row from below, column 0 at angle 0, counter-clockwise."""
    r, c = (a.ravel() for a in np.mgrid[0:rows, 0:columns])
    angle = 2.0 * np.pi * c / columns
    normal = np.stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))], axis=1)
    position = radius_m * normal
    position[:, 2] = (r - (rows - 1) / 2.0) * pitch_m
    i = np.arange(rows * columns)
    uid = (i // TAXELS_PER_MODULE + 1) << 4 | (i % TAXELS_PER_MODULE + 1)
    name = f"cylinder:rows={rows},columns={columns},radius_m={radius_m:g},pitch_m={pitch_m:g}"
    return Layout(name, uid, position, normal, radius_m)


def load(spec: str) -> Layout:
    """The layout that `skin.layout` names.

    Raises:
        SetupError: the text is not a layout, or one with no or too many taxels.
    """
    try:
        return _parse(spec)
    except ValueError as error:
        raise SetupError(f"skin.layout: {error}") from None


def _parse(spec: str) -> Layout:
    kind, _, rest = spec.partition(":")
    if kind != "cylinder":
        raise ValueError(f"'{spec}' is no known layout; use '{_example()}'")
    values: dict[str, int | float] = {}
    for item in rest.split(","):
        key, _, text = item.partition("=")
        parse = CYLINDER_KEYS.get(key)
        if parse is None:
            raise ValueError(f"unknown cylinder key '{key}'; use '{_example()}'")
        try:
            values[key] = parse(text)
        except ValueError:
            raise ValueError(f"'{item}' is not {key}=<{parse.__name__}>") from None
    missing = CYLINDER_KEYS.keys() - values
    if missing:
        raise ValueError(f"cylinder lacks {', '.join(sorted(missing))}; use '{_example()}'")
    rows, columns = int(values["rows"]), int(values["columns"])
    if not (rows > 0 and columns > 0 and rows * columns <= MAX_TAXELS):
        raise ValueError(f"rows × columns must be 1..{MAX_TAXELS}, not {rows} × {columns}")
    if not all(0.0 < values[key] < 10.0 for key in ("radius_m", "pitch_m")):
        raise ValueError("radius_m and pitch_m must be positive lengths in metres")
    return cylinder(rows, columns, float(values["radius_m"]), float(values["pitch_m"]))


def _example() -> str:
    return "cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015"
