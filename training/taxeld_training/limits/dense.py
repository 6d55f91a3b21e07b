"""The exact posterior where a bank of contacts is too thin: contacts made where it has its mass.

A contact of the prior is a line along which the skin was brought to the object, how deep it then
pressed, and the direction of that in the sensor frame. Line, depth and direction are independent,
and the last two uniform. So contacts can be drawn from a histogram over all three, which is fitted
to the posterior in a few rounds, and weighed by prior and likelihood over the histogram
(population Monte Carlo, Cappé et al. 2004). Part of it covers all lines, so that no place where the
object may be touched is given up.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from taxeld.arrays import Floats, Poses
from taxeld.model import contacts, se2
from taxeld.model.noise import Noise
from taxeld.model.observation import Observation, ObservationModel
from taxeld_training.limits.posterior import (
    Draws,
    ExactPosterior,
    effective,
    flattened,
    gains,
)
from taxeld_training.models.dataset import MIN_ACTIVATION

LINES = 200_000  # lines of the prior, from which contacts are made
PLACES, DIRECTIONS, DEPTHS = 192, 240, 24  # cells of the histogram, by axis
FIRST, EACH = 20_000, 60_000  # contacts of the bank to begin with, and contacts of a round
ROUNDS, MORE = 10, 10  # rounds that fit the histogram, and rounds that add to the last fit
FITTED = 2_000.0  # effective contacts that the histogram is fitted to
ENOUGH, FEW = 1_000.0, 200.0  # effective contacts after which no more rounds, or additions, follow
ANYWHERE = 0.2  # share of the contacts that are anywhere along the outline


class Dense:
    """p(pose | z) by contacts drawn around it, under the prior and noise of an `ExactPosterior`."""

    def __init__(self, model: ObservationModel, noise: Noise, rng: np.random.Generator) -> None:
        scene = model.scene
        self._model, self._noise = model, noise
        low, high = scene.extent
        self._ax, self._ay = rng.uniform(low[:, None], high[:, None], (2, LINES))
        self._away, self._gx, self._gy = scene.clearance(self._ax, self._ay)
        self._outline = cKDTree(np.concatenate(scene.outlines))
        place = self._place(self._ax, self._ay, self._away, self._gx, self._gy)
        self._order = np.argsort(place, kind="stable")  # the lines, place by place
        self._count = np.bincount(place, minlength=PLACES)
        self._first = np.cumsum(self._count) - self._count

    def sample(
        self,
        seen: Observation,
        n: int,
        rng: np.random.Generator,
        bank: ExactPosterior,
    ) -> Draws:
        """`n` draws with replacement for a reading, sought from those of a bank."""
        coarse = bank.sample(seen, FIRST, rng, FITTED)
        cells, weight = self._cells(coarse.pose), np.full(FIRST, 1.0 / FIRST)
        for done in range(ROUNDS + MORE):
            if done < ROUNDS:
                share = self._fitted(cells, weight)
                poses, log_ws = [], []
            cells, pose, log_w = self._drawn(share, seen, rng)
            poses.append(pose)
            log_ws.append(log_w)
            exact = flattened(np.concatenate(log_ws))
            if effective(exact) >= (ENOUGH if done < ROUNDS else FEW):
                break
            weight = flattened(log_w, FITTED)
        pick = rng.choice(len(exact), n, p=exact)
        return Draws(np.concatenate(poses)[pick], effective(exact))

    def _drawn(
        self, share: Floats, seen: Observation, rng: np.random.Generator
    ) -> tuple[NDArray[np.intp], Poses, Floats]:
        """Cells (EACH,) of a histogram, a contact (EACH, 3) in each, and its log-weight (EACH,)."""
        cells = rng.choice(share.size, EACH, p=share.ravel())
        pose, inside = self._contacts(cells, rng)
        place = cells // (DIRECTIONS * DEPTHS)
        prior = np.log(self._count[place] / share.ravel()[cells])
        likelihood, felt = self._log_likelihood(seen, pose)
        return cells, pose, np.where(inside & felt, prior + likelihood, -np.inf)

    def _place(
        self, ax: Floats, ay: Floats, away: Floats, gx: Floats, gy: Floats
    ) -> NDArray[np.intp]:
        """(N,) which part of the outline the skin's axis (ax, ay) is nearest to, `away` from it."""
        foot = np.column_stack([ax - away * gx, ay - away * gy])
        nearest = self._outline.query(foot)[1]
        return np.asarray(nearest * PLACES // self._outline.n, dtype=np.intp)

    def _cells(self, poses: Poses) -> NDArray[np.intp]:
        """(N,) the histogram's cells of contact poses (N, 3)."""
        model = self._model
        ax, ay = contacts.axis_in_object(poses)
        away, gx, gy = model.scene.clearance(ax, ay)
        depth = (model.layout.radius_m - away) / model.depth_max_m * DEPTHS
        turn = (np.arctan2(-gy, -gx) + poses[:, 2]) / (2.0 * np.pi) * DIRECTIONS
        at = (
            self._place(ax, ay, away, gx, gy),
            np.floor(turn).astype(np.intp) % DIRECTIONS,
            np.clip(depth.astype(np.intp), 0, DEPTHS - 1),
        )
        return np.ravel_multi_index(at, (PLACES, DIRECTIONS, DEPTHS))

    def _fitted(self, cells: NDArray[np.intp], weight: Floats) -> Floats:
        """(PLACES, DIRECTIONS, DEPTHS) the histogram of weighted cells, widened by a cell to every
        side; it sums to 1."""
        shape = PLACES, DIRECTIONS, DEPTHS
        share = np.bincount(cells, weight, PLACES * DIRECTIONS * DEPTHS).reshape(shape)
        for axis in range(3):
            ahead, behind = np.roll(share, 1, axis), np.roll(share, -1, axis)
            if axis == 2:  # the axis of depths does not wrap around
                ahead[..., 0], behind[..., -1] = 0.0, 0.0
            share = 0.5 * share + 0.25 * (ahead + behind)
        anywhere = self._count[:, None, None] / LINES * share.sum(axis=0)
        share = (1.0 - ANYWHERE) * share / share.sum() + ANYWHERE * anywhere / anywhere.sum()
        share[self._count == 0] = 0.0
        return np.asarray(share / share.sum())

    def _contacts(
        self, cells: NDArray[np.intp], rng: np.random.Generator
    ) -> tuple[Poses, NDArray[np.bool_]]:
        """A contact (N, 3) in each of the cells (N,), and whether the prior has it: the skin meets
        the object as deep as it should."""
        model = self._model
        radius_m = model.layout.radius_m
        place, turn, deep = np.unravel_index(cells, (PLACES, DIRECTIONS, DEPTHS))
        within = (rng.random(len(cells)) * self._count[place]).astype(np.intp)
        line = self._order[self._first[place] + within]
        depth = (deep + rng.random(len(cells))) / DEPTHS * model.depth_max_m
        direction = (turn + rng.random(len(cells))) / DIRECTIONS * 2.0 * np.pi
        gx, gy = self._gx[line], self._gy[line]
        step = radius_m - depth - self._away[line]
        ax, ay = self._ax[line] + step * gx, self._ay[line] + step * gy
        missed = np.abs(model.scene.clearance(ax, ay)[0] - radius_m + depth)
        theta = se2.wrap(direction - np.arctan2(-gy, -gx))
        return contacts.pose_of_axis(ax, ay, theta), missed <= contacts.RESIDUAL_MAX_M

    def _log_likelihood(self, seen: Observation, poses: Poses) -> tuple[Floats, NDArray[np.bool_]]:
        """(N,) of a reading at poses (N, 3), and whether the prior has such contacts felt."""
        at, h = self._model.pressed(poses)
        row, taxel = np.divmod(at, len(seen.z))
        silent, gain = gains(self._noise, seen, taxel, h)
        felt = np.bincount(row, h > MIN_ACTIVATION, len(poses)) > 0.0
        return np.asarray(silent + np.bincount(row, gain, len(poses))), felt
