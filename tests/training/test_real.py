"""Recordings of a real skin as trials and as a session, by a stand-in that is made from figures."""

import json
import runpy
from pathlib import Path

import numpy as np
import pytest

from taxeld.api import Replay
from taxeld.source import session
from taxeld_training.cli import main
from taxeld_training.trials import real, real_picture
from taxeld_training.trials.real import Arm
from tests.rig import real_skin, recorded_session
from tests.rig.commands import refused

KINDS = ["knows", "touched", "prior"]
ARM, PART = "left_arm", "head"
EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("recordings")
    real_skin.write(made)
    return made


@pytest.fixture(scope="module")
def arm(folder: Path) -> Arm:
    return real.arms_of(folder)[ARM]


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
    assert np.median([touch.error_mm for touch in last]) < 20.0
    assert all(touch.error_mm <= touch.radius_mm for touch in last)


@pytest.mark.check
def test_the_question_is_answered_by_recordings(folder: Path, tmp_path: Path) -> None:
    where = ["--out", str(tmp_path), "--memory", str(tmp_path / "memory"), "--workers", "1"]
    asked = ["evaluate", "real", "--quick", "--seeds", "1", "--data", str(folder)]
    assert main([*asked, *where]) == 0
    assert (tmp_path / "real-skin.png").exists()
    rows = json.loads((tmp_path / "real.json").read_text("utf-8"))["rows"]
    all_of = {tuple(row["of"].values()): row for row in rows if [*row["of"]] == KINDS}
    both, wrong = all_of["both", "known", "none"], all_of["one", "stranger", "none"]
    assert len(both["identity"]) == len(both["covered"]) == 12
    assert wrong["found"] == [0] * 12


def test_the_picture_is_small_and_drawn_again_with_the_same_bytes(
    folder: Path, tmp_path: Path
) -> None:
    first, again = tmp_path / "a.png", tmp_path / "b.png"
    for path in (first, again):
        real_picture.draw(folder, path)
    assert 5_000 < first.stat().st_size < 300_000
    assert first.read_bytes() == again.read_bytes()


def test_what_is_no_recording_is_refused(tmp_path: Path) -> None:
    asked = "evaluate", "real", "--out", tmp_path
    assert "--data" in refused(*asked, main=main)
    assert "no recordings" in refused(*asked, "--data", tmp_path, main=main)
    (tmp_path / "left_arm_head.npz").write_bytes(b"nothing")
    line = refused(*asked, "--data", tmp_path, main=main)
    assert "left_arm_head.npz" in line
    assert "nao_recordings.py" in line


def test_a_session_of_recorded_touches_is_replayed_touch_by_touch(arm: Arm, tmp_path: Path) -> None:
    """Whether the part is found is another question: binary readings may mislead."""
    recorded_session.write(arm, "torso", tmp_path / "session", tilt=0.1, seed=1)
    estimates = [outcome.estimate for outcome in Replay(tmp_path / "session")]
    assert sorted({each.contacts for each in estimates} - {0}) == [
        *range(1, 1 + recorded_session.TOUCHES)
    ]
    assert np.isfinite([each.map for each in estimates]).all()
    assert session.truth(tmp_path / "session") is not None


def test_the_arms_of_a_robot_are_mirrored() -> None:
    made = runpy.run_path(str(EXAMPLES / "nao_recordings.py"))
    joints = np.random.default_rng(0).uniform(-1.0, 1.0, (4, 5))
    left = made["chain"](made["LEFT"], joints)[:, :3, 3]
    right = made["chain"](made["RIGHT"], joints * [1, -1, -1, -1, -1])[:, :3, 3]
    assert np.allclose(left * [1, -1, 1], right)
    straight = made["chain"](made["LEFT"], np.zeros((1, 5)))[0, :3, 3]
    assert np.allclose(straight, [0.105 + 0.05595, 0.098 + 0.015, 0.1])
