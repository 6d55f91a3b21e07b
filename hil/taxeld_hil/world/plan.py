"""The planner of touches: which straight line each of them takes, in the world.

- `around`: towards the object from all sides in turn, at random offsets from its centre and depths.
- `random`: presses from a random side along the contact's normal, of random depth.
- Any other guide says what to touch next; the planner slows and presses where that line touches.
"""

import math
from collections.abc import Callable

import numpy as np

from taxeld.advice import lines
from taxeld.advice.advice import Approach
from taxeld.advice.lines import FELT_M, Lines
from taxeld.arrays import Floats, Poses
from taxeld.errors import SetupError
from taxeld.model import contacts, se2
from taxeld.model.observation import ObservationModel
from taxeld_hil.world.conditions import Conditions
from taxeld_hil.world.robot import ARC_STEP_RAD, SLIP_S, SLOW_FROM_M, STANDOFF_M, LinkRobot

AROUND_MOST = 8  # touches of one way around the object, so that as many see all of its sides
MARCH_M = 0.0005
CHECK_M = 0.004  # between two points at which the way to a press is checked
GRAZE_M = 5e-4  # deeper than so much the way to a press may not touch
TOUCH = 0.1  # least activation of a press: a corner between two columns may give none
TRIES = 20  # places that are tried
BATCH, PAIR_BATCH = 64, 4096  # poses drawn at once to choose presses from
BATCHES_MAX = 1000
SIDE_RAD = np.pi / 4.0  # a side reaches this far in both directions
PUSH_M = 0.25  # way of the sensor while it pushes the object
OFF_CENTRE = 0.3  # largest distance of a push from the centre, as a share of the mean radius
TWIN_GAP_M = 0.01  # gap between the object and the one beside it
TWIN_STEP_M = 0.002  # step of the search for that gap


class Circle:
    """A circle clear of an object at `truth` (3,) in the world; and lines (4, 3) from there to a
    press: where each begins, slows, touches and presses."""

    def __init__(self, model: ObservationModel, truth: Poses, reach_m: float) -> None:
        """`reach_m`: of the object from its centre."""
        self._model, self._truth = model, truth
        self.centre = se2.compose(truth, np.array([*model.scene.centre, 0.0]))[:2]
        self.radius_m = reach_m + model.layout.radius_m + STANDOFF_M

    def at(self, angle: float | Floats, radius_m: float = 0.0) -> Floats:
        """Points (…, 2) [m] at angles (…), on this circle or a wider one."""
        unit = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        return np.asarray(self.centre + max(radius_m, self.radius_m) * unit)

    def polar(self, point: Floats) -> tuple[float, float]:
        """The distance from the centre of a point (2,), and its angle."""
        x, y = point - self.centre
        return float(np.hypot(x, y)), float(np.arctan2(y, x))

    def towards(self, angle: float, yaw: float, draw: Callable[[], tuple[float, float]]) -> Poses:
        """A press from an angle. `draw` has a depth and how far it passes the centre by [m], and is
        asked again where a taxel would hardly be pressed."""
        for _ in range(TRIES):
            depth_m, offset_m = draw()
            poses = np.column_stack([self._march(angle, offset_m, depth_m), np.full(4, yaw)])
            seen = se2.compose(se2.inverse(poses[3]), self._truth)
            if self._model.activation(seen[None]).max() > TOUCH:
                break
        return poses

    def _march(self, angle: float, offset: float, depth: float) -> Floats:
        """(4, 2) points of a line. An offset at which the sensor would miss is reduced."""
        model = self._model
        inwards = -np.array([np.cos(angle), np.sin(angle)])
        sideways = np.array([-inwards[1], inwards[0]])
        far = np.sqrt(max(self.radius_m**2 - offset**2, 0.0))
        way = np.arange(0.0, far, MARCH_M)
        points = self.centre + offset * sideways - far * inwards + way[:, None] * inwards
        sensor = np.column_stack([points, np.zeros(len(points))])
        seen = se2.compose(se2.inverse(sensor), self._truth[None])
        gap = contacts.clearance(model.scene, model.layout.radius_m, seen)
        if not (gap < -depth).any():
            return self._march(angle, 0.7 * offset, depth)
        at = [0, *((gap < limit).argmax() for limit in (SLOW_FROM_M, 0.0, -depth))]
        return np.asarray(points[at])

    def normal(self, press: Poses) -> Poses:
        """Along the contact's normal to a press, the object at `press` (3,) in the sensor frame."""
        points, _ = normal_way(self._model, press, self.radius_m)
        return se2.compose(self._truth, np.column_stack([points, np.full(4, -press[2])]))

    def advised(self, approach: Approach) -> Poses | None:
        """Along an approach, until something is touched; None where nothing is."""
        line = line_of(approach)
        touched = float(lines.travel(line, self._model, self._truth[None])[0, 0])
        if not np.isfinite(touched):
            return None
        ways = touched - np.array([np.inf, FELT_M + SLOW_FROM_M, FELT_M, -approach.depth_m])
        return line.after_each(np.maximum(ways, 0.0))


def _arc(begin: float, turn: float) -> Floats:
    """(A,) angles on the way from one to another, in small steps."""
    return np.linspace(begin, begin + turn, 2 + int(abs(turn) / ARC_STEP_RAD))


def line_of(approach: Approach) -> Lines:
    """The line of an approach, as far as it goes without a touch."""
    far = float(np.linalg.norm(approach.until[:2] - approach.before[:2]))
    begin, direction = approach.before[None], np.array([approach.direction])
    return Lines(approach.link, begin, direction, np.array([far]))


def normal_way(model: ObservationModel, press: Poses, radius_m: float) -> tuple[Floats, float]:
    """(4, 2) points of the link's axis in the object's frame on the way to a press (3,) from the
    circle of a radius about the centre, and the angle of the first."""
    (ax,), (ay,) = contacts.axis_in_object(press[None])
    distance, gx, gy = (float(each[0]) for each in model.scene.clearance(ax[None], ay[None]))
    axis, away = np.array([ax, ay]), np.array([gx, gy])
    off = axis - model.scene.centre
    out = float(off @ away)
    start = -out + math.sqrt(max(out**2 - float(off @ off) + radius_m**2, 0.0))
    touch = model.layout.radius_m - distance
    ways = np.array([start, touch + SLOW_FROM_M, touch, 0.0])
    points = axis + ways[:, None] * away
    x, y = points[0] - model.scene.centre
    return points, math.atan2(y, x)


def presses(
    model: ObservationModel,
    given: Conditions,
    count: int,
    rng: np.random.Generator,
    reach_m: float,
    twin: Poses | None = None,
) -> Poses:
    """(count, 3) poses of the object in the sensor frame that press the skin, and to which a
    straight way along the normal leads. `twin` (3,): of a second object in the first one's frame,
    which as many presses as wanted press as well, and the others do not.

    Raises:
        SetupError: such poses hardly exist.
    """
    scene, radius_m = model.scene, model.layout.radius_m
    least_m, most_m = (share * model.depth_max_m for share in given.press)
    side = float(rng.uniform(-np.pi, np.pi))

    def is_clear(press: Poses, deepest_m: float) -> bool:
        """Whether the way touches nothing but at its end, and the twin no deeper than so much."""
        points, angle = normal_way(model, press, reach_m + radius_m + STANDOFF_M)
        if given.one_side and abs(se2.wrap(np.float64(angle - side))) > SIDE_RAD:
            return False
        steps = 2 + int(math.dist(points[0], points[2]) / CHECK_M)
        way = np.linspace(points[2], points[0], steps)
        if (scene.clearance(*way.T)[0] - radius_m).min() < -GRAZE_M:
            return False
        if twin is None:
            return True
        of_twin = se2.apply(se2.inverse(twin), np.vstack([way, points[3:]]))
        return bool((scene.clearance(*of_twin.T)[0] - radius_m).min() >= -deepest_m)

    def drawn(wanted: int, batch: int, also: Poses | None) -> Poses:
        """Presses (wanted, 3) of the object, and of what stands at `also` beside it."""
        found = list[Poses]()
        for _ in range(BATCHES_MAX):
            if len(found) >= wanted:
                break
            made = contacts.synthesise(scene, radius_m, most_m, batch, rng)
            kept = made.depth_m >= least_m
            for pose in (made.pose,) if also is None else (made.pose, se2.compose(made.pose, also)):
                kept &= model.activation(pose).max(axis=1) > TOUCH
            deepest_m = 0.0 if also is None else most_m
            found += [press for press in made.pose[kept] if is_clear(press, deepest_m)]
        if len(found) < wanted:
            raise SetupError("a trial's touches hardly exist: the skin misses the object there")
        return np.reshape(found[:wanted], (-1, 3))

    pairs = 0 if twin is None else min(given.both, count)
    found = np.vstack([drawn(pairs, PAIR_BATCH, twin), drawn(count - pairs, BATCH, None)])
    return found[rng.permutation(count)]


def beside(model: ObservationModel, rng: np.random.Generator) -> Poses:
    """The pose (3,) of a second object of the same kind in the frame of the first: in a random
    direction and turned at random, as far off as `TWIN_GAP_M` is between them."""
    direction, yaw = rng.uniform(-np.pi, np.pi, 2)
    scene = model.scene
    turned = se2.apply(np.array([0.0, 0.0, yaw]), scene.edge - scene.centre)
    along = np.array([np.cos(direction), np.sin(direction)])
    apart = np.arange(2.0 * scene.reach + 2.0 * TWIN_GAP_M, 0.0, -TWIN_STEP_M)
    points = turned + scene.centre + apart[:, None, None] * along
    gap = scene.clearance(points[..., 0], points[..., 1])[0].min(axis=1)
    centre = scene.centre + apart[int((gap <= TWIN_GAP_M).argmax())] * along
    corner = centre - se2.apply(np.array([0.0, 0.0, yaw]), scene.centre[None])[0]
    return np.array([*corner, yaw])


PLANNED = "around", "random", "push"  # guides that need not know what was felt


class Toucher:
    """What one link touches, touch after touch, and its robot."""

    def __init__(self, model: ObservationModel, given: Conditions, guide: str, seed: int) -> None:
        self.robot = LinkRobot(model.layout)
        self._model, self._given, self._is_around = model, given, guide == "around"
        self._reach_m = model.scene.size if self._is_around else model.scene.reach
        self._rng = np.random.default_rng(seed if self._is_around else [seed, 22])
        self._first = self._angle = float(self._rng.uniform(-np.pi, np.pi))
        self._count = 0

    def begin(self, place: Poses, touches: int, twin: Poses | None) -> None:
        """Stand beside an object at `place` (3,), which this link is to touch so often; `twin`
        (3,): a second one, in the frame of the first."""
        scene, self._touches = self._model.scene, touches
        if twin is not None:
            far = np.linalg.norm(se2.apply(twin, scene.edge) - scene.centre, axis=1)
            self._reach_m = max(self._reach_m, float(far.max()))
        self._twin, self._presses = twin, np.empty((0, 3))  # drawn when the first one is wanted
        self.robot.start(self._circle(place).at(self._first), self._first)

    def arrive(self, place: Poses, now: float, approach: Approach | None) -> Poses | None:
        """From the time `now` on, go to where the next line (4, 3) to the object at `place` (3,)
        begins; → that line, None where nothing is on it."""
        line: Poses | None
        robot, circle = self.robot, self._circle(place)
        robot.wait(now)
        least_m, was = circle.polar(robot.pose[:2])
        if self._is_around:
            was, least_m = self._angle, 0.0
            self._angle, line = self._next(circle)
            begin, turn = line[0], self._angle - was
        else:
            if approach is None:
                line = circle.normal(self._press())
                begin = line[0]
            else:
                line, begin = circle.advised(approach), approach.before
            begin_m, angle = circle.polar(begin[:2])
            turn, least_m = float(se2.wrap(np.float64(angle - was))), max(least_m, begin_m)
        self._count += 1
        robot.travel(circle.at(_arc(was, turn), least_m), float(begin[2]))
        return line

    def _press(self) -> Poses:
        """The press (3,) with the number of the next touch."""
        if not len(self._presses):
            given = self._model, self._given, self._touches
            self._presses = presses(*given, self._rng, self._reach_m, self._twin)
        return np.asarray(self._presses[self._count])

    def press(self, line: Poses, moved: Poses, rng: np.random.Generator) -> tuple[float, float]:
        """As `LinkRobot.press`, of an object that the press moves by `moved` (3,) in the world;
        `rng` draws how the sensor slips."""
        given = self._given
        places = max(round(given.hold_s / SLIP_S), 1) if given.slip_m else 1
        slips = given.slip_m * rng.standard_normal((places, 3)) * (1.0, 1.0, 0.0)
        found = self.robot.press(line, se2.compose(moved, line), given.hold_s, slips)
        if self._is_around:
            self.robot.travel(self._at_last, line[0, 2])
        return found

    def push(self, place: Poses) -> None:
        """Go along a straight line to an object at `place` (3,) and on, as long as a push takes."""
        model, rng, robot = self._model, self._rng, self.robot
        heading, yaw = rng.uniform(-np.pi, np.pi, 2)
        ahead = np.array([np.cos(heading), np.sin(heading)])
        aside = rng.uniform(-OFF_CENTRE, OFF_CENTRE) * model.scene.mean_radius
        circle = self._circle(place)
        start = circle.centre + aside * np.array([-ahead[1], ahead[0]]) - circle.radius_m * ahead
        (_, was), (_, angle) = map(circle.polar, (robot.pose[:2], start))
        far_m = 2.0 * PUSH_M + 4.0 * model.scene.size
        robot.travel(circle.at(_arc(was, float(se2.wrap(np.float64(angle - was))))), yaw)
        robot.push(np.array([*start, yaw]), np.array([*(start + far_m * ahead), yaw]))

    def _circle(self, place: Poses) -> Circle:
        return Circle(self._model, place, self._reach_m)

    def _next(self, circle: Circle) -> tuple[float, Poses]:
        """The next line towards the object's middle, or beside it, and its angle."""
        model, rng = self._model, self._rng
        step = 2.0 * np.pi / min(self._touches, AROUND_MOST)
        angle = self._first + step * (self._count + rng.uniform(-0.3, 0.3))
        yaw = self.robot.next_yaw(angle, self.robot.pose[2], rng)

        def draw() -> tuple[float, float]:
            depth_m = model.depth_max_m * rng.uniform(*self._given.press)
            return depth_m, rng.uniform(-0.7, 0.7) * model.scene.size

        self._at_last = circle.at(np.array([angle]))
        return angle, circle.towards(angle, yaw, draw)
