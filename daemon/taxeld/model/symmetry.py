"""Poses up to the object's rotation symmetry: distances, means, and modes that touch can separate.

A pose is reduced to the world position of the symmetry's centre and the turn modulo 2π/n. Both are
the same for equivalent poses, so no search over equivalents is needed.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Floats, Poses
from taxeld.model import se2
from taxeld.model.scene import CONTINUOUS, Scene

USUAL_RADIUS_M = 0.05  # mean radius of the objects for which lengths are given


@dataclass(frozen=True, slots=True)
class Mode:
    """A cluster of the belief."""

    pose: Poses  # (3,) its mean
    weight: float
    members: NDArray[np.intp]
    object: int = 0  # number of its object, of those that it may be


class PoseMetric:
    """Distances between poses of one object, in metres, blind to its symmetry."""

    def __init__(self, scene: Scene) -> None:
        self.centre = scene.centre
        self.order = scene.symmetry
        spread = scene.surface[:, :2] - scene.centre
        self.arm_m = float(np.sqrt(np.mean(np.sum(spread**2, axis=1))))  # metres a radian
        if self.order == CONTINUOUS:
            self.arm_m = 0.0
        self.scale = scene.mean_radius / USUAL_RADIUS_M  # factor on lengths for this object's size

    def centres(self, poses: Poses) -> Floats:
        """World positions (…, 2) of the symmetry's centre, for poses (…, 3)."""
        c, s = np.cos(poses[..., 2]), np.sin(poses[..., 2])
        x, y = self.centre
        return np.stack([poses[..., 0] + c * x - s * y, poses[..., 1] + s * x + c * y], axis=-1)

    def placed(self, centres: Floats, theta: Floats) -> Poses:
        """Poses (…, 3) with these centres (…, 2) and turns (…,): the inverse of `centres`."""
        c, s = np.cos(theta), np.sin(theta)
        x, y = self.centre
        at = [centres[..., 0] - c * x + s * y, centres[..., 1] - s * x - c * y, se2.wrap(theta)]
        return np.stack(at, axis=-1)

    def reduced(self, poses: Poses) -> Poses:
        """Poses (N, 3) → (N, 3), the same for equivalent poses: centre, and turn in [0, 2π/n)."""
        made = np.zeros((len(poses), 3))
        made[:, :2] = self.centres(poses)
        if self.order != CONTINUOUS:
            made[:, 2] = poses[:, 2] % (2.0 * np.pi / self.order)
        return made

    def turn(self, a: Floats, b: Floats) -> Floats:
        """The smallest turn from b to a, up to symmetry, in (−π/n, π/n]; a and b (…,) broadcast."""
        n = max(self.order, 1)
        return se2.wrap(n * (a - b)) / n

    def distance(self, a: Poses, b: Poses) -> Floats:
        """Root-mean-square displacement of surface points between poses a and b, (…, 3) each, to
        first order; broadcasts to (…,)."""
        return self._apart(self.centres(a), self.centres(b), self.turn(a[..., 2], b[..., 2]))

    def mean(self, poses: Poses, weight: Floats, near: Poses) -> tuple[Poses, Floats]:
        """Weighted mean (3,) of poses (N, 3) with weights (N,), each taken as its equivalent
        nearest to `near` (3,), and the covariance (3, 3) about it."""
        weight = weight / weight.sum()
        at, turned = self.centres(poses), poses[:, 2]
        centre, theta = self._middle(at, turned, weight, near[2])
        off = np.column_stack([at - centre, self.turn(turned, theta)])
        return self.placed(centre, theta), (off * weight[:, None]).T @ off

    def _apart(self, a: Floats, b: Floats, turn: Floats) -> Floats:
        """`distance` of poses with centres a and b, (…, 2) each, and turns between them (…,);
        broadcasts."""
        x, y = a[..., 0] - b[..., 0], a[..., 1] - b[..., 1]
        return np.asarray(np.sqrt(x**2 + y**2 + (self.arm_m * turn) ** 2))

    def _middle(
        self, at: Floats, turned: Floats, weight: Floats, near: Floats
    ) -> tuple[Floats, Floats]:
        """Weighted mean of centres (N, 2) and of turns (N,), each turn taken nearest to `near`."""
        if self.order == CONTINUOUS:
            return weight @ at, near
        return weight @ at, np.asarray(near + float(weight @ self.turn(turned, near)))

    def modes(
        self, poses: Poses, weight: Floats, radius_m: float, most: int, candidates: int
    ) -> list[Mode]:
        """Clusters of poses (N, 3) with weights (N,), heaviest first: greedy peaks of a kernel
        density.

        Peaks are sought among `candidates` particles, a comb through the weights, which bounds the
        cost: no mode that holds 1 / `candidates` of the weight is passed over.
        """
        n = len(poses)
        comb = (np.arange(candidates) + 0.5) / candidates * weight.sum()
        top = np.minimum(np.searchsorted(np.cumsum(weight), comb), n - 1)
        top = top[np.diff(top, prepend=-1) > 0]  # each once: the numbers ascend
        at, turned = self.centres(poses), poses[:, 2]
        turn = self.turn(turned[top][:, None], turned[None])
        gap = self._apart(at[top][:, None], at[None], turn)
        kernel = np.exp(-0.5 * (gap / (0.4 * radius_m)) ** 2)
        free = np.ones(n, dtype=bool)
        found: list[Mode] = []
        while len(found) < most and free.any():
            density = kernel @ (weight * free)
            density[~free[top]] = -1.0
            peak = int(density.argmax())
            if density[peak] <= 0.0:  # the free particles weigh nothing
                break
            members = np.flatnonzero(free & (gap[peak] < radius_m))
            free[members] = False
            own = weight[members]
            total = own.sum()
            middle = self._middle(at[members], turned[members], own / total, turned[top[peak]])
            found.append(Mode(self.placed(*middle), float(total), members))
        found.sort(key=lambda mode: -mode.weight)
        return found


def add_m(scene: Scene, estimate: Poses, truth: Poses) -> tuple[float, float]:
    """Average distance of surface points between two poses (3,): plain, and the least over the
    object's geometric rotation group."""
    turns = [2.0 * np.pi * k / scene.symmetry for k in range(scene.symmetry)]
    if scene.symmetry == CONTINUOUS:  # the one turn that undoes the error's
        turns = [0.0, truth[2] - estimate[2]]
    surface = scene.surface[:, :2]
    at_truth = se2.apply(truth, surface)
    poses = [se2.compose(estimate, se2.rotation_about(scene.centre, turn)) for turn in turns]
    each = [np.linalg.norm(se2.apply(pose, surface) - at_truth, axis=1).mean() for pose in poses]
    return float(each[0]), float(min(each))
