"""The simulated world: an object, the skins of one or several links, and their robots.

A seed draws the same object's place, baselines and touches under all conditions but those that
choose among them. What drives it says when scans are made, by scenario time: the skin is untouched
for `IDLE_S`, as the daemon learns its baseline then. Links touch one after the other, and nothing
keeps them from passing through each other.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from taxeld.advice.candidates import Candidate
from taxeld.arrays import Floats, Poses
from taxeld.layout.layout import Layout
from taxeld.model import se2
from taxeld.model.observation import ObservationModel
from taxeld_protocol.array import Group
from taxeld_protocol.modules import NAMES, Module, wired
from taxeld_sim.world import plan
from taxeld_sim.world.conditions import Conditions
from taxeld_sim.world.ground import Ground, gave_way
from taxeld_sim.world.mesh_skin import UPRIGHT, MeshSkin
from taxeld_sim.world.plan import PLANNED, Toucher
from taxeld_sim.world.robot import RobotPath
from taxeld_sim.world.skin import Body, SimulatedSkin, exact
from taxeld_sim.world.solids import Solid
from taxeld_sim.world.subjects import Subject, model_of, solid_of

IDLE_S = 1.5  # untouched at the start: the daemon's baseline takes 20 scans of 50 ms
LINK_SEEDS = 1_000_003  # from a link's seed to the next one's
NUDGE_RAD = np.pi / 6.0  # largest angle between a nudge and the touch's line: friction
AWAY = np.array([100.0, 100.0, 0.0])  # where the object is while it is carried elsewhere


class Step(NamedTuple):
    """The world at a moment, for one link of M taxels."""

    sensor: Poses  # (3,) as it is; `World.stated` has what the robot states
    truth: Poses  # (3,) of the object
    depth: Floats  # (M,) of the press, in depths at full scale
    counts: list[int]  # channel by channel


class World:
    """One object's place, or several one after the other, before the same skins."""

    def __init__(
        self,
        links: Sequence[ObservationModel],
        given: Conditions,
        seed: int,
        solid: Solid | None = None,
        kind: type[Module] = Module,
    ) -> None:
        """`links`: the touched object on each; `solid`: the object itself, None where the
        estimator's own model of it is touched; `kind`: of what reads the taxels, where their UIDs
        are those of modules."""
        self.links = links
        self.modules = [_wired(link.layout, kind) for link in links]  # of each link
        self.skins, self._bodies = list[SimulatedSkin](), list[Body]()
        for k, (model, own) in enumerate(zip(links, self.modules, strict=True)):
            rng = np.random.default_rng(seed + LINK_SEEDS * k)
            _placed(given, rng)
            body: Body = exact(model)
            if solid is not None:
                body = MeshSkin(solid, model.layout, given.skin.taxel_radius_m, model.depth_max_m)
            self._bodies.append(body)
            self.skins.append(SimulatedSkin(given, model.layout, own, body, rng))
        self._begin(given, seed, np.random.default_rng(seed))

    def _begin(self, given: Conditions, seed: int, rng: np.random.Generator) -> None:
        self._given, self._seed = given, seed
        self.place(_placed(given, rng))
        self._extra = np.random.default_rng([seed, 21])
        model = self.links[0]
        self.twin = plan.beside(model, self._extra) if given.both else None
        angle, turn = self._extra.uniform(-np.pi, np.pi), self._extra.choice([-1.0, 1.0])
        step = given.moved_m * np.array([np.cos(angle), np.sin(angle)])
        self._step = np.array([*step, turn * given.moved_rad])
        self._now = 0.0
        self.push_s = np.inf  # when a push begins
        self.pushed_m = 0.0  # way of the sensor while it has pushed the object
        self._before: Poses | None = None  # where the sensor was before, in a push
        self.touches = 0  # that are planned
        self.paths = [RobotPath(np.zeros(1), AWAY[None], np.zeros((1, 2))) for _ in self.links]

    def place(self, pose: Poses) -> None:
        """Have the object stand at a pose (3,), before any touch is planned."""
        self.truth = pose
        self._places = [(0.0, pose)]  # where it stands, by time on the path [s]

    def plan(self, guide: str, touches: int) -> None:
        """Have the robots touch the object so often: by `random` presses, or `around` it. By any
        other guide they begin, and are told what to touch by `touch`."""
        self._touchers = [
            Toucher(
                model,
                self._given,
                guide,
                self._seed + LINK_SEEDS * k,
                self.truth,
                len(range(k, touches, len(self.links))),
                self.twin,
                body if isinstance(body := self._bodies[k], MeshSkin) else None,
            )
            for k, model in enumerate(self.links)
        ]
        self._is_planned = guide in PLANNED
        for _ in range(touches if self._is_planned else 0):
            self.touch()
        self._take_paths()

    def reached(self) -> list[Candidate]:
        """The approaches that the robots can make to the object where it now stands."""
        place = self._places[-1][1]
        return [each for k, one in enumerate(self._touchers) for each in one.circle(place).ring(k)]

    def touch(self, candidate: Candidate | None = None, begin_s: float = 0.0) -> None:
        """Plan another touch after all before and no sooner than at the scenario time `begin_s`:
        along a candidate, or a press of the plan's own."""
        link = self.touches % len(self.links) if candidate is None else candidate.link
        toucher, place = self._touchers[link], self._places[-1][1]
        now = max(self._now, begin_s - IDLE_S)
        is_taken = self.touches > 0 and self.touches == self._given.kidnapped_after
        if is_taken:
            self._put(now, AWAY)
            place = _placed(self._given, self._extra)
        elif self.touches and self._step.any():
            place = place + self._step
            self._put(now, place)
        line = toucher.arrive(place, now, candidate)
        if is_taken:
            self._put(toucher.robot.now, place)
        if line is None and candidate is not None:
            toucher.robot.miss(*candidate.after(np.array([0.0, candidate.length_m])))
        elif line is not None:
            after = self._nudged(place, line) if self._given.nudged_m else place
            moved = se2.compose(after, se2.inverse(place))
            times = toucher.press(line, moved, self._extra)
            if after is not place:
                self._places += zip(times, (place, after), strict=True)
        self.touches += 1
        self._now = toucher.robot.now
        if not self._is_planned:
            self._take_paths()

    def push(self) -> None:
        """Plan a push along a straight line after all touches: the object gives way to it."""
        rng = np.random.default_rng([self._seed, 23])
        self._ground = Ground.drawn(self.links[0].scene, rng)
        self._pushed = self._places[-1][1]
        self._touchers[0].push(self._pushed)
        self._take_paths()
        self.push_s = float(self.touched_s()[-1, 0])

    def _give_way(self, sensor: Poses) -> None:
        """The sensor has come to a pose (3,) while it pushes."""
        before, stood = self._before, self._pushed
        if before is not None:
            self._pushed = gave_way(self.links[0], self._ground, stood, before, sensor)
            if (self._pushed != stood).any():
                self.pushed_m += float(np.linalg.norm(sensor[:2] - before[:2]))
        self._before = sensor

    def _put(self, t: float, place: Poses) -> None:
        """Have the object stand elsewhere from then on."""
        self._places += [(t, self._places[-1][1]), (t, place)]

    def _take_paths(self) -> None:
        sd = self._given.robot_m, self._given.robot_rad
        self.paths = [
            toucher.robot.path(*sd, self._seed + LINK_SEEDS * k)
            for k, toucher in enumerate(self._touchers)
        ]

    def _nudged(self, place: Poses, line: Poses) -> Poses:
        """Where a press along a line (4, 3) leaves the object: 0.5 to 1.5 × `nudged_m` away from
        the skin, up to `NUDGE_RAD` beside the line, and turned about its centre."""
        size, aside, turn = self._extra.uniform([0.5, -1.0, -1.0], [1.5, 1.0, 1.0])
        scene, (x, y) = self.links[0].scene, (line[3] - line[2])[:2]
        angle = np.arctan2(y, x) + NUDGE_RAD * aside
        moved = self._given.nudged_m * size * np.array([np.cos(angle), np.sin(angle)])
        turned = self._given.nudged_m / scene.mean_radius * turn
        about = se2.compose(place, se2.rotation_about(scene.centre, turned))
        return np.array([*(about[:2] + moved), place[2] + turned])

    @property
    def duration_s(self) -> float:
        """Scenario time to the end of the planned touches."""
        return IDLE_S + max(path.duration_s for path in self.paths)

    def touched_s(self) -> Floats:
        """(N, 2) scenario times at which the touches of all links begin and end, in their order."""
        touched = np.vstack([path.touched for path in self.paths])
        return np.asarray(IDLE_S + touched[np.argsort(touched[:, 0])])

    def truth_at(self, t: float) -> Poses:
        """The object's pose (3,) at scenario time t."""
        if t >= self.push_s:
            return self._pushed
        if len(self._places) == 1:
            return self.truth
        times, poses = zip(*self._places, strict=True)
        return RobotPath(np.array(times), np.array(poses), np.zeros((1, 2))).at(t - IDLE_S)

    def sensor(self, t: float, link: int = 0) -> Poses:
        """The true pose (3,) of a link's sensor at scenario time t."""
        return self.paths[link].at(t - IDLE_S)

    def stated(self, t: Floats | float, link: int = 0) -> Poses:
        """The poses (…, 3) that the robot states for scenario times t (…)."""
        return self.paths[link].stated(np.asarray(t) - IDLE_S)

    def step(self, t: float, link: int = 0) -> Step:
        """A scan of a link at scenario time t. Times do not go back."""
        sensor = self.sensor(t, link)
        if t >= self.push_s and not link:
            self._give_way(sensor)
        truth = self.truth_at(t)
        seen = se2.compose(se2.inverse(sensor), truth)[None]
        if self.twin is not None:
            seen = np.vstack([seen, se2.compose(seen, self.twin)])
        skin, path = self.skins[link], self.paths[link]
        touching = bool(len(path.touched)) and t - IDLE_S >= path.touched[0, 0]
        turn = path.turn(t - IDLE_S) if self._given.lean_rad else UPRIGHT
        counts = skin.counts(seen, t, touching=touching, turn=turn)
        return Step(sensor, truth, skin.depth, counts)


def planned_world(
    subject: Subject,
    specs: Sequence[str],
    given: Conditions,
    guide: str,
    touches: int,
    seed: int,
    kind: type[Module] = Module,
) -> World:
    """The world of an object and the skins of some layouts, its touches planned; `kind` as of
    `World`.

    Raises:
        SetupError: the object or a layout cannot be found, read or used.
    """
    links = model_of(subject, *specs).links
    solid = None if given.is_exact and not given.lean_rad else solid_of(subject, *specs)
    world = World(links, given, seed, solid, kind)
    world.plan(guide, touches)
    return world


def _placed(given: Conditions, rng: np.random.Generator) -> Poses:
    """Where the object stands (3,)."""
    most = np.array([given.place_m, given.place_m, np.pi])
    return rng.uniform(-most, most)


def _wired(layout: Layout, kind: type[Module]) -> tuple[Module, ...]:
    """The modules of a layout; or the groups of an array, whose names no module has."""
    name = layout.uid & 0xF
    is_module = bool(((name > 0) & (name < NAMES)).all())
    return tuple(wired(layout.uid.tolist(), kind if is_module else Group))
