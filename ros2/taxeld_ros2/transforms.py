"""ROS 2's transforms: where one frame is in another, at a time that all between them know."""

import bisect
import itertools
import math
from collections import deque
from typing import NamedTuple, Self

KEPT = 200  # transforms of one frame: two seconds at 100 a second
FRAMES_MAX = 5000  # of a robot and all around it; more are not kept
BACK_S = 1.0  # time that steps back by more begins anew
LENGTH = (0.9, 1.1)  # of a rotation's quaternion, which should be 1

Vector = tuple[float, float, float]
Turn = tuple[float, float, float, float]  # a quaternion x, y, z, w


class Rigid(NamedTuple):
    """A frame's place and turn in another."""

    at: Vector
    turn: Turn

    @classmethod
    def of(cls, at: Vector, turn: Turn) -> Self | None:
        """None where the numbers are no place or no turn."""
        length = math.sqrt(sum(q * q for q in turn))
        if not all(map(math.isfinite, (*at, *turn))) or not LENGTH[0] <= length <= LENGTH[1]:
            return None
        x, y, z, w = turn
        return cls(at, (x / length, y / length, z / length, w / length))

    def then(self, inner: "Rigid") -> "Rigid":
        """Where `inner`, given in this frame, is in the frame that this is given in."""
        x, y, z = _turned(self.turn, inner.at)
        at = (self.at[0] + x, self.at[1] + y, self.at[2] + z)
        return Rigid(at, _product(self.turn, inner.turn))

    def inverse(self) -> "Rigid":
        x, y, z, w = self.turn
        back = (-x, -y, -z, w)
        ax, ay, az = _turned(back, self.at)
        return Rigid((-ax, -ay, -az), back)

    def towards(self, other: "Rigid", share: float) -> "Rigid":
        """Between this and one near it: turns are averaged, not walked along their arc."""
        ax, ay, az = (a + share * (b - a) for a, b in zip(self.at, other.at, strict=True))
        sign = math.copysign(1.0, sum(a * b for a, b in zip(self.turn, other.turn, strict=True)))
        turn = [a + share * (sign * b - a) for a, b in zip(self.turn, other.turn, strict=True)]
        length = math.sqrt(sum(q * q for q in turn))
        x, y, z, w = (q / length for q in turn)
        return Rigid((ax, ay, az), (x, y, z, w))

    @property
    def yaw(self) -> float:
        x, y, z, w = self.turn
        return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))

    @property
    def tilt(self) -> float:
        """The angle between the two z axes."""
        x, y, *_ = self.turn
        return math.acos(max(-1.0, min(1.0, 1.0 - 2.0 * (x * x + y * y))))


class Edge:
    """A frame in its parent, as it was of late."""

    def __init__(self, parent: str, is_static: bool) -> None:
        self.parent = parent
        self.is_static = is_static
        self._held: deque[tuple[float, Rigid]] = deque(maxlen=1 if is_static else KEPT)

    @property
    def latest(self) -> float:
        """Unix seconds; of one that never changes, for ever."""
        return math.inf if self.is_static else self._held[-1][0]

    def take(self, t: float, rigid: Rigid) -> bool:
        """→ whether time has begun anew."""
        begun_anew = False
        if self._held and not self.is_static and t <= self.latest:
            begun_anew = t < self.latest - BACK_S
            if not begun_anew:
                return False
            self._held.clear()
        self._held.append((t, rigid))
        return begun_anew

    def at(self, t: float) -> Rigid | None:
        """None where t is before or after all that is held."""
        if self.is_static:
            return self._held[-1][1]
        k = bisect.bisect_left(self._held, t, key=lambda held: held[0])
        if k == len(self._held):
            return None
        after, later = self._held[k]
        if after == t:
            return later
        if k == 0:
            return None
        before, earlier = self._held[k - 1]
        return earlier.towards(later, (t - before) / (after - before))


class Transforms:
    """Where one frame is in another, from the transforms of all frames between them."""

    def __init__(self, parent: str, child: str) -> None:
        self.refused = 0  # transforms that are none
        self._ends = _plain(parent), _plain(child)
        self._edges: dict[str, Edge] = {}
        self._told = -math.inf

    def take(self, t: float, parent: str, child: str, rigid: Rigid | None, is_static: bool) -> None:
        """A transform has come, of a time in Unix seconds."""
        parent, child = _plain(parent), _plain(child)
        if rigid is None or not math.isfinite(t) or not parent or parent == child:
            self.refused += 1
            return
        edge = self._edges.get(child)
        if edge is None and len(self._edges) >= FRAMES_MAX:
            self.refused += 1
            return
        if edge is None or (edge.parent, edge.is_static) != (parent, is_static):
            edge = self._edges[child] = Edge(parent, is_static)
        if edge.take(t, rigid):
            self._told = -math.inf

    def news(self) -> tuple[float, Rigid] | None:
        """The newest time that all frames between know, and the place then; None where that is no
        later than what was told, or the frames do not hang together."""
        ways = self._ways()
        if ways is None:
            return None
        t = self._latest(ways)
        if t <= self._told or math.isinf(t):
            return None
        parent, child = (self._along(way, t) for way in ways)
        if parent is None or child is None:
            return None
        self._told = t
        return t, parent.inverse().then(child)

    def fault(self) -> str:
        """Why no place can be told, or an empty text."""
        named = {name for child, edge in self._edges.items() for name in (child, edge.parent)}
        for end in self._ends:
            if end not in named:
                return f"no transform names the frame '{end}'"
        ways, (parent, child) = self._ways(), self._ends
        if ways is None:
            return f"no transforms lead from the frame '{parent}' to '{child}'"
        if math.isinf(self._latest(ways)):
            return f"'{child}' never moves in '{parent}': no robot moves the skin"
        return ""

    def _latest(self, ways: list[list[str]]) -> float:
        return min((self._edges[name].latest for way in ways for name in way), default=math.inf)

    def _ways(self) -> list[list[str]] | None:
        """The frames from each end up to the first that both hang on, which is left out; None where
        there is none."""
        up = [self._up(end) for end in self._ends]
        common = set(up[0]) & set(up[1])
        if not common:
            return None
        return [list(itertools.takewhile(lambda name: name not in common, way)) for way in up]

    def _up(self, name: str) -> list[str]:
        """A frame, its parent, and so on."""
        way = [name]
        while name in self._edges and self._edges[name].parent not in way:
            name = self._edges[name].parent
            way.append(name)
        return way

    def _along(self, way: list[str], t: float) -> Rigid | None:
        """The first of these frames in the parent of the last, at a time."""
        held = Rigid((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        for name in way:
            rigid = self._edges[name].at(t)
            if rigid is None:
                return None
            held = rigid.then(held)
        return held


def _plain(frame: str) -> str:
    """As tf2 names it: some still begin with a slash."""
    return frame.removeprefix("/")


def _product(a: Turn, b: Turn) -> Turn:
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def _turned(turn: Turn, v: Vector) -> Vector:
    x, y, z, w = turn
    vx, vy, vz = v
    tx, ty, tz = 2 * (y * vz - z * vy), 2 * (z * vx - x * vz), 2 * (x * vy - y * vx)
    return (
        vx + w * tx + y * tz - z * ty,
        vy + w * ty + z * tx - x * tz,
        vz + w * tz + x * ty - y * tx,
    )
