"""One skin: how well it is calibrated, how much that helps, and when a fault is noticed.

A robot whose poses are off by a mount presses a box 20 times (`world.calibration_touches`); then
the same skin touches an object that stands elsewhere.
"""

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.estimator.calibration_check import Suspect
from taxeld.model import se2
from taxeld.skin.calibration import Calibration
from taxeld_hil.calibration import calibrate
from taxeld_hil.calibration.calibrate import Result
from taxeld_hil.calibration.observer import Observer
from taxeld_hil.experiment import touch_runs
from taxeld_hil.rig.rig import IDLE_S, Rig
from taxeld_hil.run.fake_run import FakeRun
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.world import calibration_touches

RATE_HZ = 40.0
AFTER = (3, 6, 10)  # touches after which errors are noted
SEEN_S = 0.4  # after the end of a touch, by when the daemon has checked it
NO_FILTER = 'proposal = "manifold"\nparticles = 50\nparticles_max = 50\ninjected = 10'


def mounted(rig: Rig, mount: Poses) -> None:
    """Have the robot state the pose of a frame in which the sensor's is `mount` (3,)."""
    true, back = rig.poses, se2.inverse(mount)

    def poses(t: float, now: float, wall: float) -> list[tuple[float, float, float, float]]:
        rows = true(t, now, wall)
        frames = [se2.compose(np.array(row[1:]), back).tolist() for row in rows]
        return [(row[0], x, y, yaw) for row, (x, y, yaw) in zip(rows, frames, strict=True)]

    rig.poses = poses  # type: ignore[method-assign]


def swapped(rig: Rig, one: int, other: int) -> None:
    """Have two modules, of as many channels, sit in each other's place."""
    channels = rig.world.channels
    at, there = (np.flatnonzero(channels.module == module) for module in (one, other))
    taxel = channels.taxel.copy()
    taxel[at], taxel[there] = channels.taxel[there], channels.taxel[at]
    channels.taxel = taxel


def calibrated(
    scenario: Scenario, seed: int, mount: Poses, *, given: bool = True
) -> tuple[Result, Floats]:
    """The result of pressing the scenario's object with its skin, and the counts (M,) that its
    taxels truly read at full depth.

    Raises:
        SetupError: the presses do not suffice.
    """
    run = FakeRun(scenario, seed, rate_hz=RATE_HZ, filter_keys=NO_FILTER if given else "")
    rig, daemon = run.rig, run.daemon
    assert daemon is not None  # noqa: S101  (no fault kills it)
    rig.path = calibration_touches.plan(rig.model, rig.world.truth, seed).path
    mounted(rig, mount)
    observer = Observer(daemon.pipeline)
    for k in range(round(rig.duration_s * RATE_HZ)):
        run.step(k / RATE_HZ)
        for outcome in daemon.outcomes:
            observer.on_outcome(outcome)
    placed = rig.world.truth if given else None
    full_scale: Floats = rig.world.physics.full_scale  # type: ignore[attr-defined]  # a soft skin
    return calibrate.fitted(observer.observed(), run.config, placed), full_scale


def errors_mm(
    scenario: Scenario, seed: int, mount: Poses, calibration: Calibration | None
) -> list[float]:
    """Errors after so many touches of AFTER, the object elsewhere than it was calibrated."""
    run = FakeRun(scenario, seed, rate_hz=RATE_HZ, calibration=calibration)
    place = np.array([scenario.place_m, scenario.place_m, np.pi])
    run.rig.world.truth = np.random.default_rng([seed, 7]).uniform(-place, place)
    run.judge = run.judging()
    plan = touch_runs.planned(scenario, run, seed + 1000)
    run.rig.path = plan.path
    mounted(run.rig, mount)
    found: list[float] = []
    k = 0
    for note_s in (IDLE_S + plan.touches[n].begin_s for n in AFTER):
        while k / RATE_HZ < note_s:
            run.step(k / RATE_HZ)
            k += 1
        last = run.judge.last
        assert last is not None  # noqa: S101  (a run has many estimates)
        found.append(round(run.judge.error_mm(last.map), 3))
    return found


def noticed(
    scenario: Scenario,
    seed: int,
    touches: int,
    *,
    factor: float = 1.0,
    mount: Poses = se2.IDENTITY,
    modules: tuple[int, int] | None = None,
) -> tuple[int, str]:
    """After which touch a doubt is raised, and what about; 0 and nothing where none is. `factor`:
    of the full scale that the daemon has, to the skin's own."""
    assumed = uniform(scenario, len(Rig(scenario, seed).model.layout), factor)
    run = FakeRun(scenario, seed, rate_hz=RATE_HZ, calibration=assumed)
    rig, daemon = run.rig, run.daemon
    assert daemon is not None  # noqa: S101  (no fault kills it)
    mounted(rig, mount)
    if modules is not None:
        swapped(rig, *modules)
    plan = touch_runs.planned(scenario, run, seed, touches, 0)
    rig.path = plan.path
    ends = [IDLE_S + touch.end_s + SEEN_S for touch in plan.touches]
    for k in range(round(ends[-1] * RATE_HZ) + 1):
        run.step(k / RATE_HZ)
        suspect = daemon.pipeline.estimator.calibration.suspect
        if suspect is not Suspect.NONE:
            return int(np.searchsorted(ends, k / RATE_HZ)) + 1, suspect.name.lower()
    return 0, ""


def uniform(scenario: Scenario, taxels: int, factor: float) -> Calibration:
    """A calibration in which all taxels are alike, and the full scale is wrong by a factor."""
    ones, zeros = np.ones(taxels), np.zeros(taxels)
    return Calibration(
        t=0.0, digest="", object=scenario.bundle, presses=0, full_scale_depth_m=0.005,
        full_scale_counts=factor * scenario.full_scale_counts, full_scale_sd=0.0,
        bend=0.0, bend_sd=0.0, mount=np.zeros(3), mount_sd=np.zeros(3),
        noise_sigma=0.04, gain_cv=0.17, gain=ones, gain_sd=zeros, onset=zeros, onset_sd=zeros,
        noise_counts=scenario.skin.noise_counts[0] * ones, frozen=zeros > 0.0,
    )  # fmt: skip
