"""How likely a contact's readings are, whatever was touched: the alternative to the known object.

A contact is explained by a local shape alone: a surface of free bend and tilt, pressed from any
side and to any depth. The density of the readings is its mean over a fixed set of such shapes.
"""

import math

import numpy as np

from taxeld.model.noise import Noise
from taxeld.model.observation import Observation, ObservationModel
from taxeld.model.response import LEAST_RATE, sagging

SHAPES = 384  # shapes, each with a depth and a side: a nat of the mean, about
SIDE_RAD = math.radians(15.0)  # the side that is pressed is this near the middle of the readings
NEAR_RAD = math.radians(60.0)  # taxels farther around the link are not reached
BEND = 200.0  # 1/m: sharpest bend, an edge of 5 mm radius; the roots of bends are uniform
SLOPE_SD = 0.15  # sd of the surface's slope along the link
BOW = 20.0  # 1/m: greatest bend along the link


class Background:
    """Local shapes pressed against one skin."""

    def __init__(self, model: ObservationModel, noise: Noise) -> None:
        self._noise = noise
        layout = model.layout
        self._place = layout.position_m
        self._angle = np.arctan2(layout.position_m[:, 1], layout.position_m[:, 0])
        rng = np.random.Generator(np.random.PCG64(0))  # the shapes are a constant
        heights, row = np.unique(layout.position_m[:, 2].round(4), return_inverse=True)
        self._row = row
        self._radius_m = layout.radius_m
        self._depth_max_m = model.depth_max_m
        self._inside = model.depth_max_m * rng.random((SHAPES, 1))
        self._turn = SIDE_RAD * rng.uniform(-1.0, 1.0, (SHAPES, 1))
        self._bend = BEND * rng.random((SHAPES, 1)) ** 2
        middle = rng.uniform(heights[0], heights[-1], (SHAPES, 1))
        along = heights - middle
        bow = BOW * rng.random((SHAPES, 1)) * (rng.random((SHAPES, 1)) < 0.5)
        gap = SLOPE_SD * rng.standard_normal((SHAPES, 1)) * along + 0.5 * bow * along**2
        self._gap = gap - gap.min(axis=1, keepdims=True)
        sides = len(np.unique(np.round(np.degrees(self._angle) / 10.0))) * math.radians(10.0)
        share = 2.0 * SIDE_RAD / min(max(sides, 2.0 * SIDE_RAD), 2.0 * math.pi)
        self._prior = math.log(share / SHAPES)

    def log_density(self, observation: Observation) -> float:
        """log p(scan of a contact | something is pressed), over the live taxels."""
        z, live = observation.z, observation.live
        noise = observation.noise or self._noise
        side = math.atan2(float(z @ np.sin(self._angle)), float(z @ np.cos(self._angle)))
        off = self._angle - side
        near = live & ((z > 0.0) | (np.cos(off) > math.cos(NEAR_RAD)))
        floor = np.broadcast_to(observation.floor, z.shape)
        residue = np.broadcast_to(observation.residue, z.shape)
        reach = np.hypot(*self._place[near, :2].T)
        turned = off[near] - self._turn
        across = reach * np.sin(turned)
        depth = reach * np.cos(turned) - self._radius_m + self._inside
        depth -= 0.5 * self._bend * across**2 + self._gap[:, self._row[near]]
        along = np.abs(np.sin(turned) + self._bend * across * np.cos(turned)) / self._depth_max_m
        of = noise.of(near)
        rate, most = (
            np.maximum(along * length, LEAST_RATE).astype(np.float32)
            for length in (of.sag_m, of.sag_m * np.exp(of.sag_sd))
        )
        depth = (depth / self._depth_max_m).astype(np.float32)
        h = np.minimum(sagging(depth, rate), 1.0)
        more = np.minimum(sagging(depth, most), 1.0) - h
        one = (each.astype(np.float32) for each in (z[near], floor[near], residue[near]))
        z_near, floor_near, residue_near = one
        spread = of.variance(h) + residue_near**2 + more * more
        excess = (np.where(z_near > 0.0, z_near, floor_near) - h) / np.sqrt(spread)
        told = of.log_of(z_near, excess, spread, of.quiet(z_near)).sum(axis=1)
        far = live & ~near
        silent = noise.of(far).log_density(z[far], np.zeros(1), floor[far], residue[far])
        top = float(told.max())
        return top + math.log(np.exp(told - top).sum()) + self._prior + float(silent.sum())
