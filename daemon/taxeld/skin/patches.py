"""Patches of touch: connected groups of pressed taxels, followed from scan to scan.

No object is needed. Two taxels are neighbours where they are within the layout's reach of each
other and do not face away from each other. A patch keeps its number while it shares taxels with
itself in the scan before; of patches that meet, the one with the largest share keeps its own.
"""

from dataclasses import dataclass

import numpy as np

from taxeld.arrays import Floats, Index, Poses
from taxeld.layout.layout import Layout

PATCHES_MAX = 16  # the strongest are told
BLOCK = 256  # taxels whose distances are looked at together
AROUND = 3  # a taxel in a grid has as many neighbours, even at a straight edge
LEAST_LENGTH = 0.1  # of a mean of unit normals that tells a direction
WIDER, WIDEST = 1.5, 2.2  # reach over the distance of the third and of the nearest taxel


@dataclass(frozen=True, slots=True)
class PressedPatch:
    """One patch, in the sensor's frame."""

    id: int  # from 1 on; kept while the patch lasts
    taxels: Index  # (P,) in the layout's order
    position_m: Floats  # (3,) centre of pressure, on the skin
    normal: Floats  # (3,) unit, outwards
    area_m2: float  # a taxel's area times the number of taxels
    sum: float  # of activations
    peak: float  # the greatest activation
    depth_m: float  # where it is pressed most


class Patches:
    """The patches of one skin."""

    def __init__(self, layout: Layout, full_scale_depth_m: float) -> None:
        """`full_scale_depth_m`: depth of an activation of 1."""
        self.layout = layout
        self.now: list[PressedPatch] = []  # strongest first
        self.left_out = 0  # patches beyond the strongest
        self._depth_m = full_scale_depth_m
        self._begun = 0
        self._before: dict[int, int] = {}  # taxel → number of its patch, in the scan before
        near_m, third_m = _spacing(layout.position_m)
        self.taxel_m2 = near_m * third_m
        self._around = _neighbours(layout, min(WIDER * third_m, WIDEST * near_m))

    def on_scan(self, z: Floats) -> list[PressedPatch]:
        """The patches of activations z (M,)."""
        pressed = np.flatnonzero(z)
        if not len(pressed):
            self.now, self.left_out, self._before = [], 0, {}
            return self.now
        groups = self._groups(pressed.tolist())
        groups.sort(key=lambda group: -float(z[group].sum()))
        self.left_out = max(len(groups) - PATCHES_MAX, 0)
        groups = groups[:PATCHES_MAX]
        numbers = self._numbers(groups)
        pairs = list(zip(numbers, groups, strict=True))
        self._before = {taxel: number for number, group in pairs for taxel in group}
        self.now = [self._patch(number, np.array(group), z) for number, group in pairs]
        return self.now

    def _groups(self, pressed: list[int]) -> list[list[int]]:
        """Connected groups of taxels, each in the layout's order."""
        left, groups = set(pressed), []
        for first in pressed:
            if first not in left:
                continue
            left.remove(first)
            group = [first]
            for taxel in group:  # grows while it is read
                found = left.intersection(self._around[taxel])
                left -= found
                group += sorted(found)
            groups.append(sorted(group))
        return groups

    def _numbers(self, groups: list[list[int]]) -> list[int]:
        """The number of each group: of the patch before with which it shares most, or a new one."""
        shares: dict[tuple[int, int], int] = {}
        for k, group in enumerate(groups):
            for taxel in group:
                if taxel in self._before:
                    pair = k, self._before[taxel]
                    shares[pair] = shares.get(pair, 0) + 1
        kept: dict[int, int] = {}
        for (k, number), _ in sorted(shares.items(), key=lambda one: (-one[1], one[0])):
            if k not in kept and number not in kept.values():
                kept[k] = number
        for k in range(len(groups)):
            if k not in kept:
                self._begun += 1
                kept[k] = self._begun
        return [kept[k] for k in range(len(groups))]

    def _patch(self, number: int, taxels: Index, z: Floats) -> PressedPatch:
        force = z[taxels]
        total, peak = float(force.sum()), float(force.max())
        strongest = int(taxels[force.argmax()])
        normal = force @ self.layout.normal[taxels]
        length = float(np.linalg.norm(normal))
        # a patch all around a thin link has no direction of its own
        if length > LEAST_LENGTH * total:
            normal = normal / length
            place = self._on_skin(force @ self.layout.position_m[taxels] / total, normal, taxels)
        else:
            normal, place = self.layout.normal[strongest], self.layout.position_m[strongest]
        return PressedPatch(
            id=number,
            taxels=taxels,
            position_m=place,
            normal=normal,
            area_m2=self.taxel_m2 * len(taxels),
            sum=total,
            peak=peak,
            depth_m=peak * self._depth_m,
        )

    def _on_skin(self, centre: Floats, normal: Floats, taxels: Index) -> Floats:
        """A mean of places (3,) lies inside a bent skin: it is moved out onto the cylinder, or
        along its normal to the height of the nearest of its taxels."""
        radius_m, distance_m = self.layout.radius_m, float(np.hypot(centre[0], centre[1]))
        if np.isfinite(radius_m) and distance_m > 0.0:
            return np.append(centre[:2] * (radius_m / distance_m), centre[2])
        places = self.layout.position_m[taxels]
        nearest = places[np.linalg.norm(places - centre, axis=1).argmin()]
        return np.asarray(centre + normal * float((nearest - centre) @ normal))


def in_world(sensor: Poses, vector: Floats, *, is_place: bool) -> Floats:
    """A place or a direction (3,) of the sensor's frame in the world; heights stay as they are.
    `sensor` (3,): the sensor's pose."""
    c, s = np.cos(sensor[2]), np.sin(sensor[2])
    x, y, z = vector
    shift = sensor[:2] if is_place else np.zeros(2)
    return np.array([shift[0] + c * x - s * y, shift[1] + s * x + c * y, z])


def _spacing(position_m: Floats) -> tuple[float, float]:
    """Median distances of a taxel's nearest and third nearest neighbours [m]; 0 where there are
    none. Their product is a taxel's area on a grid of any sides."""
    if len(position_m) < 2:
        return 0.0, 0.0
    rank = min(AROUND, len(position_m) - 1)
    nearest: list[Floats] = []
    for start in range(0, len(position_m), BLOCK):
        away = _distances(position_m, start)
        nearest.append(np.partition(away, rank, axis=1)[:, : rank + 1])
    sorted_m = np.sort(np.concatenate(nearest), axis=1)
    return float(np.median(sorted_m[:, 1])), float(np.median(sorted_m[:, rank]))


def _neighbours(layout: Layout, reach_m: float) -> list[list[int]]:
    found: list[list[int]] = []
    for start in range(0, len(layout), BLOCK):
        facing = layout.normal[start : start + BLOCK] @ layout.normal.T > 0.0
        is_near = (_distances(layout.position_m, start) <= reach_m) & facing
        found += [np.flatnonzero(row).tolist() for row in is_near]
    return found


def _distances(position_m: Floats, start: int) -> Floats:
    """(≤ BLOCK, M) distances of the taxels from `start` on to all [m]."""
    block = position_m[start : start + BLOCK, None]
    return np.asarray(np.linalg.norm(block - position_m, axis=-1))
