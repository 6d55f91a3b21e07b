"""One skin, calibrated and then used: what a calibration finds, what it buys, and what is noticed.

A robot whose poses are off by a mount, a skin of a scenario, and a box that is pressed 20 times as
`world.calibration_touches` has it; then the same skin touches an object that stands elsewhere.
"""

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.commands import calibrate
from taxeld.commands.calibration_result import Result
from taxeld.commands.hearing import Hearing, uncalibrated
from taxeld.model import se2
from taxeld_hil.rig.faults import PoseRow
from taxeld_hil.rig.rig import Rig
from taxeld_hil.run.fake_run import FakeRun
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.world import calibration_touches
from taxeld_hil.world.mesh_physics import MeshPhysics

RATE_HZ = 40.0
PRESSES = 20
QUIET = 'proposal = "manifold"\nparticles = 50\nparticles_max = 50\ninjected = 10'


def mounted(rig: Rig, mount: Poses) -> None:
    """Have the robot tell of a frame in which the sensor's is `mount` (3,)."""
    told, back = rig.poses, se2.inverse(mount)

    def poses(t: float, now: float, wall: float) -> list[PoseRow]:
        rows = [(row[0], se2.compose(np.array(row[1:]), back)) for row in told(t, now, wall)]
        return [(at, *map(float, pose)) for at, pose in rows]  # type: ignore[misc]

    rig.poses = poses  # type: ignore[method-assign]


def calibrated(
    scenario: Scenario, seed: int, mount: Poses, *, given: bool = True, presses: int = PRESSES
) -> Result:
    """The result of pressing the scenario's object with its skin.

    Raises:
        SetupError: the presses do not tell.
    """
    run = FakeRun(scenario, seed, rate_hz=RATE_HZ, filter_keys="" if not given else QUIET)
    rig, daemon = run.rig, run.daemon
    assert daemon is not None  # noqa: S101  (no fault kills it)
    rig.path = calibration_touches.plan(rig.model, rig.world.truth, seed, presses).path
    mounted(rig, mount)
    hearing = Hearing(daemon.pipeline)
    # a scan is heard as it is taken: the skin's counts are of it
    for k in range(round(rig.duration_s * RATE_HZ)):
        run.step(k / RATE_HZ)
        for outcome in daemon.outcomes:
            hearing.on_outcome(outcome)
    placed = rig.world.truth if given else None
    return calibrate.fit(hearing.heard(), uncalibrated(run.config), placed)


def full_scale(scenario: Scenario, seed: int) -> Floats:
    """(M,) counts of each taxel of that skin at full depth."""
    physics = Rig(scenario, seed).world.physics
    assert isinstance(physics, MeshPhysics)  # noqa: S101  (a soft skin)
    return physics.full_scale
