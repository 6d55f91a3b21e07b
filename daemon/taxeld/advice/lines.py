"""Straight approaches, and how far a link gets on each until it touches an object."""

from dataclasses import dataclass

import numpy as np

from taxeld.arrays import Bools, Floats, Index, Poses
from taxeld.errors import SetupError
from taxeld.model import se2
from taxeld.model.observation import ObservationModel

FAN = 24  # directions
BESIDE = 9  # lines of each direction
PAST_M = 0.01  # m behind the last hypothesis at which an approach ends
FELT_M = 1e-3  # m: a press that is felt, wherever the nearest taxel is
TOGETHER = 64  # lines and poses whose way to all points of an edge is found at once


@dataclass(frozen=True, slots=True)
class Reach:
    """What the robot can do."""

    # [least x, most x, least y, most y] of the sensor in the world; empty: the filter's square
    box_m: tuple[float, ...] = ()
    directions_deg: tuple[float, ...] = ()  # of motion in the world; empty: FAN all around
    yaw_deg: tuple[float, ...] = ()  # [least, most] yaw of the sensor; empty: any
    clearance_m: float = 0.01  # approaches begin so far from wherever the object may be
    depth_m: float = 0.003  # how far to go on once something is touched

    def __post_init__(self) -> None:
        """Raises SetupError where a range is none."""
        box, yaw = self.box_m, self.yaw_deg
        if box and not (len(box) == 4 and box[0] < box[1] and box[2] < box[3]):
            raise SetupError(f"reach: {box} is not least x, most x, least y, most y")
        if yaw and not (len(yaw) == 2 and yaw[0] <= yaw[1] <= yaw[0] + 360.0):
            raise SetupError(f"yaw: {yaw} is not least, most, at most 360 apart")


@dataclass(frozen=True, slots=True)
class Lines:
    """C straight approaches of one link."""

    link: int
    start: Poses  # (C, 3) sensor's poses in the world
    direction: Floats  # (C,) of motion in the world [rad]
    length_m: Floats  # (C,) as far as the link can go

    def __len__(self) -> int:
        return len(self.direction)

    def after_each(self, travel_m: Floats) -> Poses:
        """(T, 3) the sensor's poses on a single line after so much travel (T,)."""
        (start,), (along,) = self.start, self.direction
        ahead = np.array([np.cos(along), np.sin(along), 0.0])
        return np.asarray(start + travel_m[:, None] * ahead)

    def only(self, which: Index | Bools | slice) -> "Lines":
        """Some of the lines."""
        return Lines(self.link, self.start[which], self.direction[which], self.length_m[which])


def fan(
    reach: Reach,
    box: Floats,
    model: ObservationModel,
    link: int,
    middle: Floats,
    around_m: float,
) -> Lines:
    """Lines from all sides through and beside a point `middle` (2,), each from one side to the
    other of the circle of radius `around_m`, as far as the link reaches: `box` (2, 2) has the lower
    and the upper corner."""
    direction = np.radians(reach.directions_deg or np.arange(FAN) * (360.0 / FAN))
    offset = np.linspace(-around_m, around_m, BESIDE + 2)[1:-1]
    direction, offset = (each.ravel() for each in np.meshgrid(direction, offset, indexing="ij"))
    ahead = np.stack([np.cos(direction), np.sin(direction)], axis=1)
    aside = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    start = middle + offset[:, None] * aside - around_m * ahead
    first, last = _within(start, ahead, box)
    last = np.minimum(last, 2.0 * around_m)
    yaw = _turned(reach, direction - _front(model.links[link]))
    made = Lines(
        link, np.column_stack([start + first[:, None] * ahead, yaw]), direction, last - first
    )
    return made.only(last > first)


def _within(start: Floats, ahead: Floats, box: Floats) -> tuple[Floats, Floats]:
    """The ways (C,), (C,) at which lines from `start` (C, 2) along `ahead` (C, 2) enter a box and
    leave it."""
    along = np.where(np.abs(ahead) < 1e-9, 1e-9, ahead)
    ways = (box[:, None] - start) / along
    return np.maximum(ways.min(axis=0).max(axis=1), 0.0), ways.max(axis=0).min(axis=1)


def _front(model: ObservationModel) -> float:
    """The side of the link that has its taxels [rad], in the sensor frame; 0 if all sides have."""
    x, y = model.layout.position_m[:, :2].mean(axis=0)
    return float(np.arctan2(y, x)) if np.hypot(x, y) > 0.1 * model.layout.radius_m else 0.0


def _turned(reach: Reach, yaw: Floats) -> Floats:
    """The yaws (C,) within the range that the link has, or its nearest end."""
    if not reach.yaw_deg:
        return se2.wrap(yaw)
    low, high = np.radians(reach.yaw_deg)
    off = se2.wrap(yaw - 0.5 * (low + high))
    return np.asarray(0.5 * (low + high) + np.clip(off, 0.5 * (low - high), 0.5 * (high - low)))


def travel(lines: Lines, model: ObservationModel, poses: Poses) -> Floats:
    """(C, K) how far the link goes on C lines until it feels an object at poses (K, 3); inf where
    it passes by. The object's edge is taken for points (`Scene.edge`): what lies between two of
    them may be met a fraction of a millimetre late."""
    link = model.links[lines.link]
    scene, reach_m = link.scene, link.layout.radius_m - FELT_M
    x, y, dx, dy = _seen(lines, poses)
    found = np.where(_gap(link, x.ravel(), y.ravel()).reshape(x.shape) < -FELT_M, 0.0, np.inf)
    nx, ny = x - scene.centre[0], y - scene.centre[1]
    at = np.flatnonzero((np.abs(dx * ny - dy * nx) < scene.reach + reach_m) & np.isinf(found))
    edge = np.vstack([scene.edge.T, np.ones(len(scene.edge))]).astype(np.float32)
    of_each = np.array([dx, dy, -dx * x - dy * y, -dy, dx, dy * x - dx * y], np.float32)
    of_each = of_each.reshape(2, 3, -1).take(at, axis=2)
    for first in range(0, len(at), TOGETHER):
        block = slice(first, first + TOGETHER)
        way, aside = np.swapaxes(of_each[:, :, block], 1, 2) @ edge
        aside *= aside
        with np.errstate(invalid="ignore"):
            way -= np.sqrt(reach_m * reach_m - aside)  # NaN where the link passes by
            way[way < 0.0] = np.nan  # left behind
        found.flat[at[block]] = np.fmin.reduce(way, axis=1)
    return np.where(found <= lines.length_m[:, None], found, np.inf)


def gap_before(lines: Lines, model: ObservationModel, poses: Poses) -> Floats:
    """(C, K) gaps [m] between the link where C lines begin and an object at poses (K, 3)."""
    x, y, _, _ = _seen(lines, poses)
    return _gap(model.links[lines.link], x.ravel(), y.ravel()).reshape(x.shape)


def _seen(lines: Lines, poses: Poses) -> tuple[Floats, Floats, Floats, Floats]:
    """Where lines begin, and how they run, as seen from objects at poses (K, 3): (C, K) each."""
    turn = lines.direction[:, None] - poses[:, 2]
    x, y = lines.start[:, :1] - poses[:, 0], lines.start[:, 1:2] - poses[:, 1]
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    return c * x + s * y, c * y - s * x, np.cos(turn), np.sin(turn)


def _gap(link: ObservationModel, x: Floats, y: Floats) -> Floats:
    """(N,) gaps [m], or a little less, between a link at (x, y) in the object's frame and the
    object; negative where it is pressed."""
    scene = link.scene
    (left, low), (right, high) = scene.extent
    beyond = np.hypot(x - np.clip(x, left, right), y - np.clip(y, low, high))
    within = scene.clearance(x, y)[0]  # of the nearest point of the grid, from where it is farther
    apart = np.where(beyond > 0.0, np.hypot(np.maximum(within, 0.0), beyond), within)
    return np.asarray(apart - link.layout.radius_m)
