"""Recordings of a real skin as trials and as a session, by a stand-in that is made from figures."""

import copy
import json
import runpy
import shutil
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from taxeld.api import Replay
from taxeld.skin.fit import RELIABLE
from taxeld.stream import topics
from taxeld_hil.grade.grade import grade
from taxeld_hil.grade.session import PUBLISHED, Run, add
from taxeld_hil.scenario.scenario import Scenario
from taxeld_training.cli import main
from taxeld_training.evaluation import real
from taxeld_training.evaluation.real import Arm
from tests.rig import real_skin
from tests.rig.commands import printed, refused, refuses

KINDS = ["knows", "touched", "prior"]
ARM, PART = "left_arm", "head"
EXAMPLES = Path(__file__).parents[2] / "examples"
WRITER = runpy.run_path(str(EXAMPLES / "nao_session.py"))
Said = dict[str, Any]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("recordings")
    real_skin.write(made)
    return made


@pytest.fixture(scope="module")
def arm(folder: Path) -> Arm:
    return real.arms_of(folder)[ARM]


@pytest.fixture(scope="module")
def recorded(arm: Arm, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its first taxel never answers."""
    made, less = tmp_path_factory.mktemp("recorded") / "session", copy.copy(arm)
    less.skin = arm.skin._replace(share=np.append(0.0, arm.skin.share[1:]))
    WRITER["write"](less, "torso", made, tilt=0.1, seed=1)
    return made


def test_half_a_tells_which_taxels_answer_and_from_where(arm: Arm, tmp_path: Path) -> None:
    share, skin = real_skin.write(tmp_path), arm.skin
    pressed = np.abs(skin.share - real.USUAL[0]) > 0.01  # others are as before
    assert np.corrcoef(skin.share[pressed], share[pressed])[0, 1] > 0.6
    assert abs(skin.cover_m - real_skin.COVER_M) < 0.001


def test_a_trial_has_upright_touches_of_half_b_each_of_another_pose(arm: Arm) -> None:
    recording = arm.recordings[PART]
    for tilt in (0.1, 0.2):
        _, at = recording.drawn(tilt, seed=0)
        assert len(at) == len(np.unique(recording.repeat[at])) > 0
        assert recording.is_b[at].all()
        assert (recording.tilt[at] < tilt).all()
        assert not np.isin(recording.repeat[~recording.is_b], recording.repeat[at]).any()


def test_a_part_is_found_and_no_estimate_misleads(arm: Arm) -> None:
    trials = [real.play(arm, (PART, (PART,), 0.2, "2 cm", 8), seed) for seed in range(3)]
    last = [trial[-1] for trial in trials]
    assert min(touch.error_mm for touch in last) < 20.0
    assert all(touch.error_mm <= touch.radius_mm for touch in last)


@pytest.mark.check
def test_the_question_is_answered_by_recordings(folder: Path, tmp_path: Path) -> None:
    where = ["--out", str(tmp_path), "--memory", str(tmp_path / "memory"), "--workers", "1"]
    asked = ["evaluate", "real", "--quick", "--seeds", "1", "--data", str(folder)]
    assert main([*asked, *where]) == 0
    rows = json.loads((tmp_path / "real.json").read_text("utf-8"))["rows"]
    all_of = {tuple(row["of"].values()): row for row in rows if [*row["of"]] == KINDS}
    both, wrong = all_of["both", "known", "none"], all_of["one", "stranger", "none"]
    assert len(both["identity"]) == len(both["covered"]) == 12
    assert wrong["found"] == [0] * 12


def test_what_is_no_recording_is_refused(tmp_path: Path) -> None:
    asked = "evaluate", "real", "--out", tmp_path
    assert "--data" in refused(*asked, main=main)
    assert "no recordings" in refused(*asked, "--data", tmp_path, main=main)
    (tmp_path / "left_arm_head.npz").write_bytes(b"nothing")
    line = refused(*asked, "--data", tmp_path, main=main)
    assert "left_arm_head.npz" in line
    assert "nao_recordings.py" in line
    for half, said in (("a", "left_arm_head.npz is no recording"), ("c", "not c")):
        refuses(said, WRITER["main"], tmp_path, "left_arm_head", half, tmp_path / "session")


def test_a_session_has_each_recorded_touch_and_is_graded(recorded: Path, tmp_path: Path) -> None:
    """Whether the part is found is another question."""
    place = shutil.copytree(recorded, tmp_path / "session")
    said = [json.loads(line) for line in printed("replay", place).splitlines()]
    count = range(1, 1 + WRITER["TOUCHES"])
    assert {each["contacts"] for each in said} - {0} == {*count}
    with (place / PUBLISHED).open("wb") as file:
        for each in said:
            add(file, each["t"], topics.ESTIMATE, msgpack.packb(each))
    scenario = Scenario(str(place / "part"), layout=str(place / "arm.csv"), transport="array")
    Run("recorded", 0, "real", scenario, said[-1]["t"], ()).write(place)
    grade(place).write(place)
    told = json.loads((place / "grade.json").read_text("utf-8"))
    assert (told["estimates"], told["contacts"]) == (len(said), count[-1])
    assert 0 <= told["misleading"]["estimates"] <= told["sure"]


def test_a_sessions_calibration_has_the_shares_of_answers_of_half_a(
    arm: Arm, recorded: Path
) -> None:
    """A taxel that never answers is not live."""
    skin, share = Replay(recorded).pipeline.skin, np.tile(arm.skin.share, real.BANDS)
    share[:: len(arm.skin.share)] = 0.0
    assert np.allclose(skin.noise.answers, np.clip(share, 1.0 - RELIABLE, RELIABLE), atol=1e-5)
    assert skin.faults()["stuck_taxels"] == np.flatnonzero(share < real.LEAST_SHARE).tolist()


def test_the_arms_of_a_robot_are_mirrored() -> None:
    made = runpy.run_path(str(EXAMPLES / "nao_recordings.py"))
    joints = np.random.default_rng(0).uniform(-1.0, 1.0, (4, 5))
    left = made["chain"](made["LEFT"], joints)[:, :3, 3]
    right = made["chain"](made["RIGHT"], joints * [1, -1, -1, -1, -1])[:, :3, 3]
    assert np.allclose(left * [1, -1, 1], right)
    straight = made["chain"](made["LEFT"], np.zeros((1, 5)))[0, :3, 3]
    assert np.allclose(straight, [0.105 + 0.05595, 0.098 + 0.015, 0.1])
