"""How deep a solid presses each taxel of a soft skin around a rigid link.

The link may lean. Each point of the skin gives way along its normal, as deep as the solid reaches:
a ray from inside the link outwards first meets the solid at a depth u. A taxel reads the mean over
its electrode. Beside the contact the skin's cover sags, by exp(−s/λ) of u at a distance s, like a
membrane on springs, with a λ of each taxel; where that is more than the mean, the taxel reads it.
The solid is filled: a wall may be thinner than the press is deep.
"""

import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Floats, Poses
from taxeld.layout.layout import Layout
from taxeld.model import se2
from taxeld_sim.world.solids import Solid

LATTICE_M = (0.002, 0.003)  # around and along, of the skin's points beside the electrodes'
MARGIN_M = 0.008  # width of the simulated skin around the taxels
LAYER_M = 0.008  # how deep the skin can give way, or more of deeper foam
LAYER = 1.6  # the same, in full depths
STEP_M = 0.001  # along a ray
LEAST_M = 5e-6  # smaller sags are left out: 20 of 20 000 counts
ELECTRODE = np.vstack([[0.0, 0.0], *([np.cos(a), np.sin(a)] for a in np.arange(6) * np.pi / 3)])
ELECTRODE_RADII = np.sqrt(7.0 / 12.0)  # of the outer six points: their mean distance is a disc's
UPRIGHT: Floats = np.eye(3)  # the turn of a link that does not lean


class MeshSkin:
    """The indentation of a skin's M taxels, vectorised over the skin's points."""

    def __init__(
        self, solid: Solid, layout: Layout, taxel_radius_m: float, depth_max_m: float
    ) -> None:
        """Its foam reads full scale at `depth_max_m`."""
        self._solid = solid
        self._taxels = len(layout)
        self._middle_of = layout.position_m  # (M, 3) centres of the electrodes
        self._radius_m = taxel_radius_m
        angle = np.arctan2(layout.position_m[:, 1], layout.position_m[:, 0])
        radius = np.hypot(layout.position_m[:, 0], layout.position_m[:, 1])
        spots = ELECTRODE if taxel_radius_m else ELECTRODE[:1]
        spread = ELECTRODE_RADII * taxel_radius_m * spots
        self._spots = len(spots)
        on_taxel = np.stack(
            [
                (angle[:, None] + spread[:, 0] / radius[:, None]).ravel(),
                (layout.position_m[:, 2, None] + spread[:, 1]).ravel(),
                np.repeat(radius, len(spots)),
            ]
        )
        between = _lattice(angle, layout.position_m[:, 2], radius)
        phi, z, r = np.concatenate([on_taxel, between], axis=1)
        self._normal = np.stack([np.cos(phi), np.sin(phi), np.zeros(len(phi))])
        self._point = np.stack([r * self._normal[0], r * self._normal[1], z])
        self._full_m = depth_max_m
        self._layer_m = max(LAYER_M, LAYER * depth_max_m)
        self._depths = np.arange(0.0, self._layer_m + 0.5 * STEP_M, STEP_M)
        self._reach = solid.size + float(np.linalg.norm(self._point, axis=0).max())

    def __call__(self, seen: Poses, sag_m: Floats, turn: Floats = UPRIGHT) -> Floats:
        """(M,) depths in full scales, of the nearest of objects at poses (K, 3); as a `Body`."""
        deepest = np.max([self.indentation(one, sag_m, turn) for one in seen], axis=0)
        return np.asarray(deepest / self._full_m)

    def indentation(self, seen: Poses, sag_m: Floats, turn: Floats = UPRIGHT) -> Floats:
        """(M,) [m] of each taxel, the object at `seen` (3,) in the upright sensor frame; `sag_m`
        (M,): the length λ of each, where 0 is a taxel beside which nothing sags; `turn` (3, 3): of
        the link in that frame, about its origin."""
        at, depth = self._met(seen, turn)
        on_taxel = np.zeros(self._taxels * self._spots)
        own = at < len(on_taxel)
        on_taxel[at[own]] = depth[own]
        pressed = on_taxel.reshape(self._taxels, self._spots).mean(axis=1)
        if not len(at) or not sag_m.any():
            return np.asarray(pressed)
        return np.asarray(np.maximum(pressed, self._sagging(at, depth, sag_m)))

    def deepest_m(self, seen: Poses, turn: Floats) -> float:
        """How deep the object presses the taxel that it presses most; or the whole layer, where any
        point of the skin can give way no more. As of `indentation`."""
        at, depth = self._met(seen, turn)
        if depth.max(initial=0.0) >= self._layer_m:
            return self._layer_m
        return float(depth[at < self._taxels * self._spots].max(initial=0.0))

    def _sagging(self, at: NDArray[np.intp], depth: Floats, sag_m: Floats) -> Floats:
        """(M,) [m] by points (k,) of the skin that are pressed so deep, beside the electrodes."""
        gap = self._point[:, at, None] - self._middle_of.T[:, None]
        apart = np.sqrt(np.einsum("ckm,ckm->km", gap, gap))
        beside = apart > self._radius_m
        with np.errstate(divide="ignore"):
            share = np.log(depth)[:, None] - apart / sag_m
        sagging = np.exp(np.where(beside, share, -np.inf).max(axis=0))
        return np.where(sagging >= LEAST_M, sagging, 0.0)

    def _met(self, seen: Poses, turn: Floats) -> tuple[NDArray[np.intp], Floats]:
        """Indices (k,) of the skin's points that the solid presses, and how deep (k,) [m]."""
        middle = se2.apply(seen, self._solid.centre[None])[0]
        if np.hypot(*middle) >= self._reach:
            return np.empty(0, np.intp), np.empty(0)
        own, normal = turn @ self._point, turn @ self._normal
        x, y = se2.apply(se2.inverse(seen), own[:2].T).T
        off_x, off_y = x - self._solid.centre[0], y - self._solid.centre[1]
        near = np.flatnonzero(np.hypot(off_x, off_y) < self._solid.size + self._layer_m)
        point = np.stack([x, y, own[2]]).take(near, axis=1)
        gap = self._solid.distance(point)
        able = np.flatnonzero(gap <= self._layer_m)
        close, point = near[able], point[:, able]
        if not (gap <= 0.0).any():  # no point of the undeformed surface is inside the solid
            return close[:0], np.empty(0)
        c, s = np.cos(seen[2]), np.sin(seen[2])
        inwards = -np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ normal[:, close]
        way = point[:, :, None] + inwards[:, :, None] * self._depths
        distance = self._solid.distance(way.reshape(3, -1)).reshape(len(close), -1)
        inside = distance <= 0.0
        hit = np.flatnonzero(inside.any(axis=1))
        deepest = len(self._depths) - 1 - inside[hit, ::-1].argmax(axis=1)
        within = distance[hit, deepest]
        beyond = distance[hit, np.minimum(deepest + 1, len(self._depths) - 1)]
        part = within / np.where(beyond > within, within - beyond, 1.0)
        return close[hit], self._depths[deepest] + STEP_M * np.clip(part, 0.0, 1.0)


def _lattice(angle: Floats, z: Floats, radius: Floats) -> Floats:
    """(3, n) angle, height and radius of points of the skin, all around each taxel."""
    mean = float(radius.mean())
    steps = int(2.0 * np.pi * mean / LATTICE_M[0])
    heights = np.arange(z.min() - MARGIN_M, z.max() + MARGIN_M + 1e-9, LATTICE_M[1])
    phi, height = (a.ravel() for a in np.meshgrid(np.arange(steps) * 2.0 * np.pi / steps, heights))
    nearest = np.empty(len(phi), dtype=np.intp)
    gap = np.empty(len(phi))
    for start in range(0, len(phi), 1024):
        part = slice(start, start + 1024)
        around = mean * se2.wrap(phi[part, None] - angle)
        apart = np.hypot(around, height[part, None] - z)
        nearest[part], gap[part] = apart.argmin(axis=1), apart.min(axis=1)
    kept = gap < MARGIN_M
    return np.stack([phi[kept], height[kept], radius[nearest[kept]]])
