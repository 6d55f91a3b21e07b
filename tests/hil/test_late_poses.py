"""A robot whose poses are a period late: its scans are placed by the speed of the last two, nearer
than the robot's own error, and the object is found."""

from dataclasses import replace

import numpy as np

from taxeld.arrays import Poses
from taxeld.config.tables import SensorPoseConfig
from taxeld.model.symmetry import add_m
from taxeld.pipeline.poses import EXTRAPOLATE_S
from taxeld_hil.run.fake import FakeRun
from taxeld_hil.scenario import scenario

DEMO = replace(scenario.load("demo").on("scene"), contacts=4)


def run(extrapolate_s: float) -> tuple[float, float, int]:
    """→ the final error [mm], the most that a touch's place was off [mm], and the scans that
    waited."""
    ran = FakeRun(DEMO, 0)
    assert ran.daemon is not None
    pipeline, take = ran.daemon.pipeline, ran.daemon.pose
    track, at = pipeline.poses, pipeline.poses.at
    track.extrapolate_s = extrapolate_s  # type: ignore[union-attr]
    told, placed = list[tuple[float, ...]](), list[tuple[float, Poses]]()

    def pose(*row: float) -> None:
        told.append(row)
        if len(told) > 1:
            take(*told[-2])  # type: ignore[arg-type]

    def placing(t: float) -> Poses | None:
        found = at(t)
        if found is not None and pipeline.skin.touched:
            placed.append((t, found))
        return found

    ran.daemon.pose = pose  # type: ignore[method-assign]
    track.at = placing  # type: ignore[method-assign]
    ran.run()
    error_m = add_m(ran.rig.model.scene, pipeline.estimate.map, ran.rig.world.truth)[1]
    t, x, y, *_ = np.array(told).T
    off = [sensor[:2] - [np.interp(at_s, t, x), np.interp(at_s, t, y)] for at_s, sensor in placed]
    most_m = np.linalg.norm(off, axis=1).max()
    return 1e3 * error_m, 1e3 * float(most_m), pipeline.inputs.scans_waited


def test_scans_after_the_last_pose_are_placed_within_what_the_robot_errs() -> None:
    waited_mm, exact_mm, waited = run(0.0)
    placed_mm, off_mm, not_waited = run(EXTRAPOLATE_S)
    assert waited > 100
    assert not_waited < 0.1 * waited
    assert exact_mm < 1e-6
    assert off_mm < 0.5 * 1e3 * SensorPoseConfig().sigma_m
    assert max(waited_mm, placed_mm) < DEMO.expect.error_mm
