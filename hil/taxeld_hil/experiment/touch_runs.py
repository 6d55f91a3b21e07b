"""One run of touches on the fake clock: what the daemon made of them, and felt in the air."""

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
PAIRS = 4  # of a press and a light one, after them
AFTER = (3, 6, 8, 10)  # touches, errors are noted
RATE_HZ = 40.0  # ticks, where none is late: as the soak's
FOUND_MM = 10.0  # an error below this
SAME_S = 1e-4  # a reading and its truth are of one scan


@dataclass(slots=True)
class TouchRun:
    """Of one seed; `light` and `missed` count light touches, the rest is of the presses before."""

    object: str
    skin: str
    seed: int
    error_mm: list[float] = field(default_factory=list)  # after AFTER touches, up to symmetry
    converged: list[bool] = field(default_factory=list)  # then
    truth_nats: list[float | None] = field(default_factory=list)  # then, where it is not found
    scans: int = 0
    air: int = 0  # of them, in which the object pressed no taxel
    felt_in_air: int = 0  # of those, in which the daemon felt one
    contacts: int = 0  # that the daemon counted
    silent_episodes: int = 0  # valid, converged and more than 20 mm off
    light: int = 0
    missed: int = 0  # of the light ones: no taxel that was pressed was felt in any scan of the hold


@dataclass(slots=True)
class _Witness:
    """Physics that remember how deep each taxel was pressed in each scan."""

    inner: MeshPhysics
    depth_m: dict[int, Floats] = field(default_factory=dict)  # by time, in SAME_S

    def press(self, seen: Poses, t: float) -> Floats:
        counts = self.inner.press(seen, t)
        self.depth_m[round(t / SAME_S)] = self.inner.depth_m
        return counts

    def drift(self, t: float) -> tuple[Floats | float, float]:
        return self.inner.drift(t)

    def pressed(self, t: float) -> Bools:
        """(M,) at the scan of time t."""
        return self.depth_m[round(t / SAME_S)] > 0.0


def play(scenario: Scenario, seed: int, filter_keys: str = "") -> TouchRun:
    """The scenario's object and skin, touched by `touches.plan`; `filter_keys`: TOML for the
    daemon's [filter].

    Raises:
        SetupError: the object has no mesh here, or there are faults in `filter_keys`.
    """
    run = FakeRun(scenario, seed, rate_hz=RATE_HZ, filter_keys=filter_keys)
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
    """Touches of the scenario's object where it stands."""
    model, truth = run.rig.model, run.rig.world.truth
    solid, radius_m = solid_of(scenario.bundle, model.layout), scenario.skin.taxel_radius_m
    skin = MeshSkin(solid, model.layout, radius_m, sags=False)
    hard = np.zeros(len(model.layout))

    def deepest(sensor: Poses) -> float:
        return float(skin.indentation(se2.compose(se2.inverse(sensor), truth), hard).max())

    return touches.plan(model, truth, deepest, seed, presses, pairs)


def _note(found: TouchRun, run: FakeRun) -> None:
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
