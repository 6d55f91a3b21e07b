"""ROS 2's transforms: where one frame is in another, at a time that all between them know.

A frame's place in another is a homogeneous matrix (4, 4); lengths are metres, times Unix seconds.
"""

import math
from bisect import bisect_left
from collections import deque
from collections.abc import Sequence
from itertools import takewhile
from operator import itemgetter

import numpy as np

from taxeld.arrays import Floats

KEPT = 200  # places of one frame: two seconds at 100 a second
BACK_S = 1.0  # a stamp older than the last by more means that a clock was set back
LENGTH = (0.9, 1.1)  # of a rotation's quaternion, which should be 1


def matrix(at: Sequence[float], turn: Sequence[float]) -> Floats | None:
    """(4, 4) of a position (3,) and a quaternion x, y, z, w; None of numbers that are no place."""
    length = math.hypot(*turn)
    if not all(map(math.isfinite, (*at, *turn))) or not LENGTH[0] <= length <= LENGTH[1]:
        return None
    x, y, z, w = (q / length for q in turn)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), at[0]],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), at[1]],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), at[2]],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def between(a: Floats, b: Floats, share: float) -> Floats:
    """A place (4, 4) from `a` to `b`, which is near it: the mean, made a rotation again."""
    made = a + share * (b - a)
    u, _, vt = np.linalg.svd(made[:3, :3])
    made[:3, :3] = u @ vt
    return made


class Transforms:
    """Where one frame is in another, from the transforms of all frames between them."""

    def __init__(self, parent: str, child: str) -> None:
        """`child` is looked for in `parent`; both are names of frames."""
        self._ends = _plain(parent), _plain(child)
        self._parent: dict[str, str] = {}
        self._held: dict[str, deque[tuple[float, Floats]]] = {}  # places of a frame in its parent
        self._last_s = -math.inf  # the newest time that was asked for and known

    def take(self, t: float, parent: str, child: str, place: Floats | None) -> None:
        """Keep a transform, `place` (4, 4); `t` is infinite for a static one. None is left out."""
        parent, child = _plain(parent), _plain(child)
        if place is None or math.isnan(t) or not parent or parent == child:
            return
        held = self._held.setdefault(child, deque(maxlen=KEPT))
        is_reset = math.isinf(t) or (held and t < held[-1][0] - BACK_S)
        if is_reset or self._parent.get(child) != parent:
            held.clear()
        self._parent[child] = parent
        if not held or t > held[-1][0]:
            held.append((t, place))

    def news(self) -> tuple[float, Floats] | None:
        """The newest time that all frames between know, and the place (4, 4) then; None where it
        is the same time as before, or no frames that move lead from one to the other."""
        ways = self._ways()
        t = min((self._held[name][-1][0] for way in ways for name in way), default=math.inf)
        if math.isinf(t) or t == self._last_s:
            return None
        places = [self._along(way, t) for way in ways]
        if places[0] is None or places[1] is None:
            return None
        self._last_s = t
        return t, np.linalg.inv(places[0]) @ places[1]

    def _along(self, way: list[str], t: float) -> Floats | None:
        """The place (4, 4) of a way's first frame in the parent of its last."""
        place = np.eye(4)
        for name in way:
            step = self._at(name, t)
            if step is None:
                return None
            place = step @ place
        return place

    def _at(self, name: str, t: float) -> Floats | None:
        """A frame in its parent, (4, 4); None where `t` is outside the times that are held."""
        held = self._held[name]
        k = bisect_left(held, t, key=itemgetter(0))
        if k == len(held):
            return None
        after, later = held[k]
        if after == t or math.isinf(after):
            return later
        if k == 0:
            return None
        before, earlier = held[k - 1]
        return between(earlier, later, (t - before) / (after - before))

    def _ways(self) -> list[list[str]]:
        """The frames from each end up to the first frame above both, which is left out; empty where
        there is none."""
        up = [self._up(end) for end in self._ends]
        common = set(up[0]) & set(up[1])
        return [list(takewhile(lambda n: n not in common, way)) for way in up] if common else []

    def _up(self, name: str) -> list[str]:
        """A frame, its parent, and so on; a ring of frames ends where it began."""
        way = [name]
        while (name := self._parent.get(name, "")) and name not in way:
            way.append(name)
        return way


def _plain(frame: str) -> str:
    """A frame's name as tf2 has it: some programs begin it with a slash."""
    return frame.removeprefix("/")
