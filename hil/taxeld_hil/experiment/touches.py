"""`taxeld-hil touches`: how well an object is found by ten touches of a soft skin.

Where an object is not found, the likelihood tells why. A true pose that is far likelier than the
estimate was overlooked: a search of all poses would have found it. If it is not likelier, no search
could have told it from the estimate: the touches so far, or the model, do not suffice.
"""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field

import numpy as np

from taxeld.arrays import Bools, Floats, Poses
from taxeld.estimator.estimate import Status
from taxeld.estimator.estimator import Estimator
from taxeld.estimator.mixture import Mixture
from taxeld.model import se2
from taxeld.model.activation import Activation
from taxeld_hil.experiment.measurement import RunRow, digest, require
from taxeld_hil.integrity import is_found
from taxeld_hil.jobs import Job, layout_name
from taxeld_hil.rig.rig import IDLE_S
from taxeld_hil.run.fake_run import FakeRun
from taxeld_hil.scenario import scenario as scenarios
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.world import touches as paths
from taxeld_hil.world.bundled import solid_of
from taxeld_hil.world.mesh_physics import MeshPhysics
from taxeld_hil.world.mesh_skin import MeshSkin
from taxeld_hil.world.touches import Touch, TouchPlan

PRESSES = 10
PAIRS = 4  # after the presses: a press and a light touch each
AFTER = (3, 6, 8, 10)  # touches: errors are noted when so many have ended
RATE_HZ = 40.0  # ticks of the daemon, as in the soak
SAME_S = 1e-4  # times of a reading and of its truth that differ by less are of one scan
CLOSE_MM = 5.0
OVERLOOKED_NATS = 3.0  # a pose that is likelier by more is far likelier: 20 to 1
AROUND = np.array([0.004, 0.004, 0.06])  # sd [m, m, rad] of the first poses tried around one
SHARES = (1.0, 0.5, 0.25, 0.12, 0.06, 0.03)  # the sd of each round, as shares of AROUND
TRIED = 400  # poses a round


def jobs(
    objects: Sequence[str], skins: Sequence[str], seeds: int, layouts: Sequence[str] = ("",)
) -> list[Job]:
    """A job for each run with bundles, skins and layouts, seed by seed.

    Raises:
        SetupError: there is no such object or skin, an object has no mesh here, or there are no
            seeds.
    """
    require(objects, skins, seeds, layouts, soft=True)
    demo = scenarios.load("demo")
    subjects = [
        demo.touching(name).on(skin, layout)
        for layout in layouts
        for skin in skins
        for name in objects
    ]
    return [
        Job(f"{_what(s)}, seed {seed}", figures, (s, seed), code=digest(s))
        for seed in range(seeds)
        for s in subjects
    ]


def _what(subject: Scenario) -> str:
    words = [subject.bundle, subject.physics, layout_name(subject.layout)]
    return ", ".join(filter(None, words))


def figures(subject: Scenario, seed: int) -> RunRow:
    """One run, as JSON has it."""
    return asdict(play(subject, seed))


def described(run: RunRow) -> str:
    """A run's errors, in short."""
    return f"{run['error_mm']} mm after {AFTER}"


def lines(runs: Sequence[RunRow]) -> Iterator[str]:
    """Errors and failures as a Markdown table: a row a skin, object and layout."""
    head = [
        "skin, object",
        *(f"median (p90) mm, < 5 mm after {n}" for n in AFTER),
        *(f"not found after {n}, overlooked" for n in AFTER[-2:]),
        "felt in the air",
        "light ones missed",
        "misleading",
    ]
    yield "| " + " | ".join(head) + " |"
    yield "|---" * len(head) + "|"
    rows: dict[str, list[RunRow]] = {}
    for run in runs:
        words = [run["skin"], run["object"], run.get("layout", "")]
        rows.setdefault(", ".join(filter(None, words)), []).append(run)
    for name, mine in rows.items():
        errors = np.array([run["error_mm"] for run in mine])  # (runs, len(AFTER))
        nats = np.array([run["truth_nats"] for run in mine], dtype=float)  # nan: found
        lost = (~is_found(errors)).sum(axis=0)
        overlooked = (nats > OVERLOOKED_NATS).sum(axis=0)
        scans, felt, light, missed = (
            sum(run[key] for run in mine) for key in ("scans", "felt_in_air", "light", "missed")
        )
        cells = [
            name,
            *map(_errors, errors.T),
            *(f"{lost[k]}, {overlooked[k]}" for k in (-2, -1)),
            f"{felt / scans:.1%}",
            f"{missed / light:.0%} of {light}",
            _misled(mine),
        ]
        yield "| " + " | ".join(cells) + " |"


def _misled(runs: Sequence[RunRow]) -> str:
    """The share of runs with a misleading estimate at any tick."""
    if not all("misleading_episodes" in run for run in runs):
        return "not measured"
    return f"{np.mean([run['misleading_episodes'] > 0 for run in runs]):.1%}"


def _errors(error_mm: Sequence[float]) -> str:
    """Median and 90th percentile of errors (runs,) [mm], and the share that is close."""
    error = np.asarray(error_mm)
    median, p90 = (
        f"{value:.0f}" if value >= 100.0 else f"{value:.3g}"
        for value in np.quantile(error, (0.5, 0.9))
    )
    return f"{median} ({p90}), {np.mean(error < CLOSE_MM):.0%}"


@dataclass(slots=True)
class TouchRun:
    """The run of one seed. `light` and `missed` count the light touches at its end; all else is of
    the presses before them."""

    object: str
    skin: str
    seed: int
    error_mm: list[float] = field(default_factory=list)  # after AFTER touches, up to symmetry
    converged: list[bool] = field(default_factory=list)  # after AFTER touches
    truth_nats: list[float | None] = field(default_factory=list)  # the same; None: it is found
    scans: int = 0
    air: int = 0  # scans in which the object pressed no taxel
    felt_in_air: int = 0  # scans in which it pressed none, but the daemon felt one
    contacts: int = 0  # counted by the daemon
    misleading_episodes: int = 0
    light: int = 0
    missed: int = 0  # light touches: no pressed taxel was felt in any scan of the hold
    layout: str = ""  # its name; empty: what the bundle was built for


@dataclass(slots=True)
class _Witness:
    """Physics that remember how deep each taxel was pressed in each scan."""

    inner: MeshPhysics
    depth_m: dict[int, Floats] = field(default_factory=dict)  # (M,) by time in units of SAME_S

    def press(self, seen: Poses, t: float) -> Floats:
        """Like `Physics.press`: `seen` (3,) at t [s] → counts (M,)."""
        counts = self.inner.press(seen, t)
        self.depth_m[round(t / SAME_S)] = self.inner.depth_m
        return counts

    def drift(self, t: float) -> tuple[Floats | float, float]:
        return self.inner.drift(t)

    def pressed(self, t: float) -> Bools:
        """(M,) whether each taxel was pressed in the scan at t [s]."""
        return self.depth_m[round(t / SAME_S)] > 0.0


def play(scenario: Scenario, seed: int) -> TouchRun:
    """The scenario's object and skin, touched by `world.touches.plan`.

    Raises:
        SetupError: the object has no mesh here.
    """
    run = FakeRun(scenario, seed, rate_hz=RATE_HZ)
    rig, daemon = run.rig, run.daemon
    assert daemon is not None  # noqa: S101  (no fault kills it)
    assert isinstance(rig.world.physics, MeshPhysics)  # noqa: S101  (a soft skin)
    witness = rig.world.physics = _Witness(rig.world.physics)
    plan = planned(scenario, run, seed)
    rig.path = plan.path
    layout = layout_name(scenario.layout)
    found = TouchRun(scenario.bundle, scenario.physics, seed, layout=layout)
    notes = [IDLE_S + plan.touches[n].begin_s for n in AFTER if n < len(plan.touches)]
    last_s = IDLE_S + plan.touches[PRESSES].begin_s
    light = {touch: False for touch in plan.touches if touch.is_light}
    for k in range(round(rig.duration_s * RATE_HZ)):
        t = k / RATE_HZ
        while notes and notes[0] <= t:
            _note(found, run)
            notes.pop(0)
            if not notes:
                found.contacts = daemon.pipeline.estimate.contacts
                found.misleading_episodes = run.judge.tally.misleading_episodes
        run.step(t)
        for activation in (o.activation for o in daemon.outcomes if o.activation is not None):
            pressed = witness.pressed(activation.t)
            if t < last_s:
                _count(found, activation, pressed)
            for touch in light:
                if _held(touch, activation.t - IDLE_S) and (activation.z > 0.0)[pressed].any():
                    light[touch] = True
    found.light, found.missed = len(light), sum(not felt for felt in light.values())
    return found


def planned(
    scenario: Scenario, run: FakeRun, seed: int, presses: int = PRESSES, pairs: int = PAIRS
) -> TouchPlan:
    """Touches of the scenario's object where it stands: presses, then pairs of a press and a light
    touch."""
    model, truth = run.rig.model, run.rig.world.truth
    solid, radius_m = solid_of(scenario.bundle, model.layout), scenario.skin.taxel_radius_m
    skin = MeshSkin(solid, model.layout, radius_m, sags=False)
    hard = np.zeros(len(model.layout))

    def deepest(sensor: Poses) -> float:
        """How deep the strongest taxel is pressed [m], the sensor at a pose (3,)."""
        return float(skin.indentation(se2.compose(se2.inverse(sensor), truth), hard).max())

    return paths.plan(model, truth, deepest, seed, presses, pairs)


def _note(found: TouchRun, run: FakeRun) -> None:
    """Add the error now."""
    last = run.judge.last
    assert last is not None  # noqa: S101  (a run has many estimates)
    assert run.daemon is not None  # noqa: S101  (no fault kills it)
    error_mm = round(run.judge.error_mm(last.map), 3)
    found.error_mm.append(error_mm)
    found.converged.append(last.status == Status.CONVERGED)
    lost, estimator = not is_found(error_mm), run.daemon.pipeline.estimator
    found.truth_nats.append(truth_nats(estimator, run.rig.world.truth) if lost else None)


def _count(found: TouchRun, activation: Activation, pressed: Bools) -> None:
    found.scans += 1
    if not pressed.any():
        found.air += 1
        found.felt_in_air += bool((activation.z > 0.0).any())


def _held(touch: Touch, t: float) -> bool:
    return touch.held_s[0] <= t <= touch.held_s[1]


def truth_nats(estimator: Estimator, truth: Poses) -> float | None:
    """How much likelier [nats] the best pose around the truth (3,) is than the best pose around the
    estimate; None: the estimator's rule remembers no touches."""
    if not isinstance(estimator.rule, Mixture):
        return None
    best = [_best(estimator.rule, pose) for pose in (truth, estimator.estimate.map)]
    return round(best[0] - best[1], 2)


def _best(rule: Mixture, pose: Poses) -> float:
    """The log posterior [nats] of the best pose that is found around a pose (3,)."""
    rng = np.random.default_rng(0)
    best = float(_log_posterior(rule, pose[None])[0])
    for share in SHARES:
        near = pose + share * AROUND * rng.standard_normal((TRIED, 3))
        found = _log_posterior(rule, near)
        if found.max() > best:
            best, pose = float(found.max()), near[found.argmax()]
    return best


def _log_posterior(rule: Mixture, poses: Poses) -> Floats:
    """(N,) log posterior [nats] of poses (N, 3), up to a constant."""
    return rule.memory.runs.support(rule.memory.explain(poses))
