"""Patches of touch: connected groups of pressed taxels, followed from scan to scan.

No object is needed. Two taxels are neighbours where they are within the layout's reach of each
other and do not face away from each other. A patch keeps its number while it shares taxels with
itself in the scan before; of patches that meet, the one with the largest share keeps its own.
"""

from collections import Counter
from dataclasses import dataclass
from itertools import count

import numpy as np

from taxeld.arrays import Floats, Index, Poses
from taxeld.layout.layout import Layout
from taxeld.model import se2

PATCHES_MAX = 16  # the strongest are told
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
        self._new = count(1)  # numbers of new patches
        self._before: dict[int, int] = {}  # taxel → number of its patch, in the scan before
        # median distances of a taxel's nearest and third nearest; 0 where there are none
        rank = min(AROUND, len(layout) - 1)
        nearest = [np.partition(apart, rank)[:, : rank + 1].copy() for _, apart in layout.apart_m()]
        ranked = np.sort(np.concatenate(nearest))[:, [min(1, rank), rank]]
        near_m, third_m = np.median(ranked, axis=0).tolist()
        self.taxel_m2 = near_m * third_m  # on a grid of any sides
        reach_m = min(WIDER * third_m, WIDEST * near_m)
        self._around: list[list[int]] = []
        for rows, apart in layout.apart_m():
            for normal, is_near in zip(layout.normal[rows], apart <= reach_m, strict=True):
                near = np.flatnonzero(is_near)
                self._around.append(near[layout.normal[near] @ normal > 0.0].tolist())

    def on_scan(self, z: Floats) -> list[PressedPatch]:
        """The patches of activations z (M,)."""
        groups = self._groups(z)
        self.left_out = max(len(groups) - PATCHES_MAX, 0)
        groups = groups[:PATCHES_MAX]
        pairs = list(zip(self._numbers(groups), groups, strict=True))
        self._before = {taxel: number for number, group in pairs for taxel in group.tolist()}
        self.now = [self._patch(number, group, z) for number, group in pairs]
        return self.now

    def _groups(self, z: Floats) -> list[Index]:
        """Connected groups of pressed taxels, the strongest first; each in the layout's order."""
        left, groups = set(np.flatnonzero(z).tolist()), []
        while left:
            group = [left.pop()]
            for taxel in group:  # grows while it is read
                found = left.intersection(self._around[taxel])
                left -= found
                group += found
            groups.append(np.array(sorted(group)))
        return sorted(groups, key=lambda group: (-float(z[group].sum()), group[0]))

    def _numbers(self, groups: list[Index]) -> list[int]:
        """The number of each group: of the patch before with which it shares most, or a new one."""
        owners = ((k, self._before.get(i)) for k, own in enumerate(groups) for i in own.tolist())
        shares = Counter((k, number) for k, number in owners if number is not None)
        kept: dict[int, int] = {}
        for k, number in sorted(shares, key=lambda pair: (-shares[pair], pair)):
            if k not in kept and number not in kept.values():
                kept[k] = number
        return [kept.get(k) or next(self._new) for k in range(len(groups))]

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
    frame = sensor if is_place else np.append(np.zeros(2), sensor[2])
    return np.append(se2.apply(frame, vector[None, :2]), vector[2])
