"""The planner of touches: which straight line each of them takes, in the world.

- `random`: presses from a random side along the contact's normal, of random depth.
- `around`: the same, from all sides in turn.
- Any other guide says what to touch next; the planner slows and presses where that line touches.
"""

import math

import numpy as np

from taxeld.advice.candidates import FELT_M, Candidate, depth_m, way_until_felt
from taxeld.arrays import Floats, Poses
from taxeld.errors import SetupError
from taxeld.model import contacts, se2
from taxeld.model.observation import ObservationModel
from taxeld_sim.world.conditions import Conditions
from taxeld_sim.world.mesh_skin import MeshSkin
from taxeld_sim.world.robot import (
    ARC_STEP_RAD,
    SLIP_S,
    SLOW_FROM_M,
    STANDOFF_M,
    LinkRobot,
    turned,
)

PLANNED = "around", "random", "push"  # guides that need not know what was felt
AROUND_MOST = 8  # touches of one way around the object, so that as many see all of its sides
JITTER = 0.3  # of such a touch's side, as a share of the way to the next one
CHECK_M = 0.004  # between two points at which the way to a press is checked
GRAZE_M = 5e-4  # deeper than so much the way to a press may not touch
TOUCH = 0.1  # least activation of a press: a corner between two columns may give none
BATCH, PAIR_BATCH = 64, 4096  # poses drawn at once to choose presses from
BATCHES_MAX = 1000
SIDE_RAD = np.pi / 4.0  # a side reaches this far in both directions
PUSH_M = 0.25  # way of the sensor while it pushes the object
OFF_CENTRE = 0.3  # largest distance of a push from the centre, as a share of the mean radius
RING, RING_BESIDE = 12, 5  # directions from which a robot reaches the object, and lines of each
BESIDE = 0.8  # how far beside its middle the outer ones are, as a share of its size
TWIN_GAP_M = 0.01  # gap between the object and the one beside it
TWIN_STEP_M = 0.002  # step of the search for that gap
LEAN_M, LEAN_STEP_M = 0.08, 1e-5  # how far a link that leans is moved to press, and how exactly
UPRIGHT_TILT: Floats = np.zeros(2)


class Circle:
    """A circle clear of an object at `truth` (3,) in the world; and lines (4, 3) from there to a
    press: where each begins, slows, touches and presses."""

    def __init__(self, model: ObservationModel, truth: Poses, reach_m: float) -> None:
        """`reach_m`: of the object from its centre."""
        self._model, self._truth = model, truth
        self.centre = se2.compose(truth, np.array([*model.scene.centre, 0.0]))[:2]
        self.radius_m = _clear_m(model, reach_m)

    def at(self, angle: float | Floats, radius_m: float = 0.0) -> Floats:
        """Points (…, 2) [m] at angles (…), on this circle or a wider one."""
        unit = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        return np.asarray(self.centre + max(radius_m, self.radius_m) * unit)

    def polar(self, point: Floats) -> tuple[float, float]:
        """The distance from the centre of a point (2,), and its angle."""
        x, y = point - self.centre
        return float(np.hypot(x, y)), float(np.arctan2(y, x))

    def normal(self, press: Poses) -> Poses:
        """Along the contact's normal to a press, the object at `press` (3,) in the sensor frame."""
        (points,) = _normal_ways(self._model, press[None], self.radius_m)
        return se2.compose(self._truth, np.column_stack([points, np.full(4, -press[2])]))

    def ring(self, link: int) -> list[Candidate]:
        """Straight approaches of a link from all sides, to the object's middle and beside it."""
        layout, angle = self._model.layout, np.linspace(-np.pi, np.pi, RING, endpoint=False)
        x, y = layout.position_m[:, :2].mean(axis=0)
        ahead = math.atan2(y, x) if math.hypot(x, y) > 0.1 * layout.radius_m else 0.0
        widest = math.asin(BESIDE * self._model.scene.size / self.radius_m)
        found = []
        for aside in np.linspace(-widest, widest, RING_BESIDE):
            begin, end = self.at(angle + np.pi - aside), self.at(angle + aside)
            rows = np.column_stack([begin, se2.wrap(angle - ahead), end])
            found += [Candidate(x, y, theta, x1, y1, link) for x, y, theta, x1, y1 in rows.tolist()]
        return found

    def along(self, candidate: Candidate) -> Poses | None:
        """Along a candidate, until something is touched; None where nothing is."""
        touched = float(way_until_felt(candidate, self._model, self._truth[None])[0])
        if not np.isfinite(touched):
            return None
        ways = touched - np.array([np.inf, FELT_M + SLOW_FROM_M, FELT_M, -depth_m(self._model)])
        return candidate.after(np.maximum(ways, 0.0))


def _clear_m(model: ObservationModel, reach_m: float) -> float:
    """Radius of a circle on which the sensor is clear of an object that reaches so far."""
    return reach_m + model.layout.radius_m + STANDOFF_M


def _normal_ways(model: ObservationModel, presses: Poses, radius_m: float) -> Floats:
    """(N, 4, 2) points of the link's axis in the object's frame on the way to presses (N, 3) from
    the circle of a radius about the centre."""
    axis = np.column_stack(contacts.axis_in_object(presses))
    distance, *gradient = model.scene.clearance(*axis.T)
    away, off = np.column_stack(gradient), axis - model.scene.centre
    out = np.sum(off * away, axis=1)
    start = np.sqrt(np.maximum(out**2 - np.sum(off**2, axis=1) + radius_m**2, 0.0)) - out
    touch = model.layout.radius_m - distance
    ways = np.stack([start, touch + SLOW_FROM_M, touch, 0.0 * touch], axis=1)
    return np.asarray(axis[:, None] + ways[:, :, None] * away[:, None])


def presses(
    model: ObservationModel,
    given: Conditions,
    count: int,
    rng: np.random.Generator,
    reach_m: float,
    twin: Poses | None = None,
    *,
    around: bool = False,
) -> Poses:
    """(count, 3) poses of the object in the sensor frame that press the skin, and to which a
    straight way along the normal leads. `twin` (3,): of a second object in the first one's frame,
    which as many presses as wanted press as well, and the others do not. `around`: from all sides
    of the object in turn.

    Raises:
        SetupError: such poses hardly exist.
    """
    scene, radius_m = model.scene, model.layout.radius_m
    least_m, most_m = (share * model.depth_max_m for share in given.press)
    side = float(rng.uniform(-np.pi, np.pi))

    def is_clear(points: Floats, deepest_m: float) -> bool:
        """Whether a way (4, 2) touches nothing but at its end, and the twin no deeper than so
        much."""
        steps = 2 + int(math.dist(points[0], points[2]) / CHECK_M)
        way = np.linspace(points[2], points[0], steps)
        if (scene.clearance(*way.T)[0] - radius_m).min() < -GRAZE_M:
            return False
        if twin is None:
            return True
        of_twin = se2.apply(se2.inverse(twin), np.vstack([way, points[3:]]))
        return bool((scene.clearance(*of_twin.T)[0] - radius_m).min() >= -deepest_m)

    def drawn(wanted: int, side: float, within_rad: float, also: Poses | None = None) -> Poses:
        """Presses (wanted, 3) of the object, and of what stands at `also` beside it, from within an
        angle of a side."""
        found = list[Poses]()
        for _ in range(BATCHES_MAX):
            if len(found) >= wanted:
                break
            batch = BATCH if also is None else PAIR_BATCH
            made = contacts.synthesise(scene, radius_m, most_m, batch, rng)
            ways = _normal_ways(model, made.pose, _clear_m(model, reach_m))
            x, y = (ways[:, 0] - scene.centre).T
            angle = np.arctan2(y, x)
            kept = (made.depth_m >= least_m) & (np.abs(se2.wrap(angle - side)) <= within_rad)
            for pose in (made.pose,) if also is None else (made.pose, se2.compose(made.pose, also)):
                kept &= model.activation(pose).max(axis=1) > TOUCH
            deepest_m = 0.0 if also is None else most_m
            kept[kept] = [is_clear(way, deepest_m) for way in ways[kept]]
            found += [*made.pose[kept]]
        if len(found) < wanted:
            raise SetupError("a trial's touches hardly exist: the skin misses the object there")
        return np.reshape(found[:wanted], (-1, 3))

    if around:
        step = 2.0 * np.pi / min(max(count, 1), AROUND_MOST)
        sides = side + step * np.arange(count)
        return np.reshape([drawn(1, each, JITTER * step) for each in sides], (-1, 3))
    within_rad = SIDE_RAD if given.one_side else np.pi
    pairs = 0 if twin is None else min(given.both, count)
    both, one = drawn(pairs, side, within_rad, twin), drawn(count - pairs, side, within_rad)
    return np.vstack([both, one])[rng.permutation(count)]


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


class Toucher:
    """What one link touches, touch after touch, and its robot."""

    def __init__(
        self,
        model: ObservationModel,
        given: Conditions,
        guide: str,
        seed: int,
        place: Poses,
        touches: int,
        twin: Poses | None,
        body: MeshSkin | None,
    ) -> None:
        """The robot begins beside an object at `place` (3,), which this link is to touch so often;
        `twin` (3,): a second one, in the frame of the first; `body`: the skin, where the link is to
        lean."""
        self._model, self._given, self._body = model, given, body
        self._rng = rng = np.random.default_rng([seed, 22])
        self._leans = np.random.default_rng([seed, 24])
        scene, self._reach_m = model.scene, model.scene.reach
        if twin is not None:
            far = np.linalg.norm(se2.apply(twin, scene.edge) - scene.centre, axis=1)
            self._reach_m = max(self._reach_m, float(far.max()))
        circle = self.circle(place)
        start = np.array([*circle.at(float(rng.uniform(-np.pi, np.pi))), 0.0])
        around = guide == "around"
        found = presses(model, given, touches, rng, self._reach_m, twin, around=around)
        self._presses = iter(found)
        self.robot = LinkRobot(circle.normal(found[0])[0] if touches else start)

    def arrive(self, place: Poses, now: float, candidate: Candidate | None) -> Poses | None:
        """From the time `now` on, go to where the next line (4, 3) to the object at `place` (3,)
        begins; → that line, None where nothing is on it."""
        circle = self.circle(place)
        self.robot.wait(now)
        if candidate is None:
            line, tilt = self._leaning(circle.normal(next(self._presses)), place)
            self._travel(circle, line[0], tilt)
            return line
        met, tilt = circle.along(candidate), UPRIGHT_TILT
        if met is not None:
            met, tilt = self._leaning(met, place)
        self._travel(circle, candidate.after(np.zeros(1))[0], tilt)
        return met

    def _leaning(self, line: Poses, place: Poses) -> tuple[Poses, Floats]:
        """A line (4, 3) to an object at `place` (3,) and the link's tilt (2,) there: moved along
        itself so that the skin is pressed as deep as upright."""
        if self._body is None or not self._given.lean_rad:
            return line, UPRIGHT_TILT
        direction = self._leans.uniform(-np.pi, np.pi)
        tilt = self._given.lean_rad * np.array([np.cos(direction), np.sin(direction)])
        turn, press = turned(tilt), line[3] - line[2]
        depth_m = float(np.linalg.norm(press[:2]))
        low_m, high_m = -LEAN_M, LEAN_M
        while high_m - low_m > LEAN_STEP_M:
            middle_m = 0.5 * (low_m + high_m)
            sensor = line[3] + middle_m / depth_m * press
            is_deep = self._body.deepest_m(se2.compose(se2.inverse(sensor), place), turn) > depth_m
            low_m, high_m = (low_m, middle_m) if is_deep else (middle_m, high_m)
        return line + low_m / depth_m * press, tilt

    def _travel(self, circle: Circle, begin: Poses, tilt: Floats) -> None:
        """Go around the object to a pose (3,), no nearer to it than the two ends of the way."""
        (was_m, was), (begin_m, angle) = map(circle.polar, (self.robot.pose[:2], begin[:2]))
        turn = float(se2.wrap(np.float64(angle - was)))
        way = np.linspace(was, was + turn, 2 + int(abs(turn) / ARC_STEP_RAD))
        self.robot.travel(circle.at(way, max(was_m, begin_m)), float(begin[2]), tilt)

    def press(self, line: Poses, moved: Poses, rng: np.random.Generator) -> tuple[float, float]:
        """As `LinkRobot.press`, of an object that the press moves by `moved` (3,) in the world;
        `rng` draws how the sensor slips."""
        given = self._given
        places = max(round(given.hold_s / SLIP_S), 1) if given.slip_m else 1
        slips = given.slip_m * rng.standard_normal((places, 3)) * (1.0, 1.0, 0.0)
        return self.robot.press(line, se2.compose(moved, line), given.hold_s, slips)

    def push(self, place: Poses) -> None:
        """Go along a straight line to an object at `place` (3,) and on, as long as a push takes."""
        scene, rng = self._model.scene, self._rng
        heading, yaw = rng.uniform(-np.pi, np.pi, 2)
        ahead = np.array([np.cos(heading), np.sin(heading), 0.0])
        aside = rng.uniform(-OFF_CENTRE, OFF_CENTRE) * scene.mean_radius
        circle = self.circle(place)
        middle = np.array([*circle.centre, yaw]) + aside * np.array([-ahead[1], ahead[0], 0.0])
        start = middle - circle.radius_m * ahead
        self._travel(circle, start, UPRIGHT_TILT)
        self.robot.push(start, start + (2.0 * PUSH_M + 4.0 * scene.size) * ahead)

    def circle(self, place: Poses) -> Circle:
        """About the object at a place (3,)."""
        half_m = float(np.abs(self._model.layout.position_m[:, 2]).max())  # of the link's length
        beyond_m = math.sin(self._given.lean_rad) * half_m
        return Circle(self._model, place, self._reach_m + beyond_m)
