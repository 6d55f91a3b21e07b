"""One run of touches on the fake clock: the errors of the estimate, and what the daemon felt."""

from dataclasses import dataclass, field

import numpy as np

from taxeld.arrays import Bools, Floats, Poses
from taxeld.estimator.estimate import Status
from taxeld.model import se2
from taxeld.model.activation import Activation
from taxeld_hil.experiment.overlooked import truth_nats
from taxeld_hil.rig.rig import IDLE_S
from taxeld_hil.run.fake_run import FakeRun
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.world import touches
from taxeld_hil.world.bundled import solid_of
from taxeld_hil.world.mesh_physics import MeshPhysics
from taxeld_hil.world.mesh_skin import MeshSkin
from taxeld_hil.world.touches import Touch, Touches

PRESSES = 10
PAIRS = 4  # after the presses: a press and a light touch each
AFTER = (3, 6, 8, 10)  # touches: errors are noted when so many have ended
RATE_HZ = 40.0  # of the daemon's ticks, as in the soak
FOUND_MM = 10.0  # with an error below this the object is found
SAME_S = 1e-4  # times of a reading and of its truth that differ by less are of one scan


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
    silent_episodes: int = 0  # valid, converged and more than 20 mm off
    light: int = 0
    missed: int = 0  # light touches: no pressed taxel was felt in any scan of the hold


@dataclass(slots=True)
class _Witness:
    """Physics that remember how deep each taxel was pressed in each scan."""

    inner: MeshPhysics
    depth_m: dict[int, Floats] = field(default_factory=dict)  # (M,) by time in units of SAME_S

    def press(self, seen: Poses, t: float) -> Floats:
        counts = self.inner.press(seen, t)
        self.depth_m[round(t / SAME_S)] = self.inner.depth_m
        return counts

    def drift(self, t: float) -> tuple[Floats | float, float]:
        return self.inner.drift(t)

    def pressed(self, t: float) -> Bools:
        """(M,) whether each taxel was pressed in the scan at t [s]."""
        return self.depth_m[round(t / SAME_S)] > 0.0


def play(scenario: Scenario, seed: int) -> TouchRun:
    """The scenario's object and skin, touched by `touches.plan`.

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
    found = TouchRun(scenario.bundle, scenario.physics, seed)
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
                found.silent_episodes = run.judge.tally.silent_episodes
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
) -> Touches:
    """Touches of the scenario's object where it stands: presses, then pairs of a press and a light
    touch."""
    model, truth = run.rig.model, run.rig.world.truth
    solid, radius_m = solid_of(scenario.bundle, model.layout), scenario.skin.taxel_radius_m
    skin = MeshSkin(solid, model.layout, radius_m, sags=False)
    hard = np.zeros(len(model.layout))

    def deepest(sensor: Poses) -> float:
        return float(skin.indentation(se2.compose(se2.inverse(sensor), truth), hard).max())

    return touches.plan(model, truth, deepest, seed, presses, pairs)


def _note(found: TouchRun, run: FakeRun) -> None:
    """Add the error now."""
    last = run.judge.last
    assert last is not None  # noqa: S101  (a run has many estimates)
    assert run.daemon is not None  # noqa: S101  (no fault kills it)
    error_mm = round(run.judge.error_mm(last.map), 3)
    found.error_mm.append(error_mm)
    found.converged.append(last.status == Status.CONVERGED)
    lost, estimator = error_mm >= FOUND_MM, run.daemon.pipeline.estimator
    found.truth_nats.append(truth_nats(estimator, run.rig.world.truth) if lost else None)


def _count(found: TouchRun, activation: Activation, pressed: Bools) -> None:
    found.scans += 1
    if not pressed.any():
        found.air += 1
        found.felt_in_air += bool((activation.z > 0.0).any())


def _held(touch: Touch, t: float) -> bool:
    return touch.held_s[0] <= t <= touch.held_s[1]
