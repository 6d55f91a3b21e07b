"""An object that is pushed, and the experiment on it."""

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from taxeld.errors import SetupError
from taxeld.model import contacts, se2
from taxeld.model.observation import ObservationModel
from taxeld_training.filters import push
from taxeld_training.filters.pusher import DEPTH_M, STEP_M, TOUCHES, PushedTrial, gave_way
from taxeld_training.jobs.options import Options

LIMIT_M = 0.03


def depth(model: ObservationModel, pose: np.ndarray, sensor: np.ndarray) -> float:
    seen = se2.compose(se2.inverse(sensor), pose)[None]
    return -float(contacts.clearance(model.scene, model.layout.radius_m, seen)[0])


def test_the_object_gives_way_until_friction_holds_it(
    ring_model: ObservationModel,
) -> None:
    scans = [scan for scan in PushedTrial(ring_model, 0) if scan.touch == TOUCHES]
    depths = [depth(ring_model, scan.truth, scan.sensor) for scan in scans]
    assert max(depths) < DEPTH_M + 3e-4
    assert np.mean(np.array(depths) > DEPTH_M - 3e-4) > 0.5


def test_the_object_stands_until_it_is_pushed_and_moves_no_farther_than_the_sensor(
    ring_model: ObservationModel,
) -> None:
    scans = list(PushedTrial(ring_model, 0))
    start = scans[0].truth
    for before, after in pairwise(scans):
        if depth(ring_model, before.truth, after.sensor) < DEPTH_M:
            assert np.array_equal(before.truth, after.truth)
    gap = se2.compose(se2.inverse(start), scans[-1].truth)
    assert 0.1 < np.hypot(gap[0], gap[1]) < STEP_M * len(scans)


def test_a_push_through_the_centre_does_not_turn_the_object(ring_model: ObservationModel) -> None:
    before = np.array([0.03 + 0.04 - DEPTH_M, 0.0, 0.0])
    after = before - [STEP_M, 0.0, 0.0]
    pose = gave_way(ring_model, np.zeros(3), before, after, LIMIT_M)
    assert np.allclose(pose, [-STEP_M, 0.0, 0.0], atol=[2e-4, 2e-4, 2e-3])


def test_the_quick_run_writes_a_row_an_object_and_motion(tmp_path: Path) -> None:
    options = Options(
        out=tmp_path, memory=tmp_path / "memory", quick=True, objects=("003_cracker_box",),
        workers=1,
    )  # fmt: skip
    (path,) = push.run(options)
    rows = json.loads(path.read_text(encoding="utf-8"))
    assert [(row["object"], row["motion"]) for row in rows] == [
        ("003_cracker_box", "push"), ("003_cracker_box", "none"),
    ]  # fmt: skip
    followed, ignored = (row["path_mm"]["median"] for row in rows)
    assert followed < ignored


def test_an_object_without_a_bundle_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(SetupError, match="016_pear has no shipped bundle"):
        push.run(Options(out=tmp_path, memory=tmp_path, objects=("016_pear",)))
