"""`taxeld calibrate`: of a session, of a skin that is pressed now, and the check of a session."""

import json
import re
import threading
import time
from dataclasses import replace
from pathlib import Path

import msgpack
import numpy as np
import pytest
import zmq

from taxeld.cli import main
from taxeld.config.file import load
from taxeld.config.tables import SceneConfig, SkinConfig
from taxeld.errors import SetupError
from taxeld.model import se2
from taxeld.service import calibration_file
from taxeld.skin.calibration import Calibration
from taxeld.stream import topics
from taxeld_hil.calibration import calibrate, check
from taxeld_hil.calibration.command import Guided
from taxeld_hil.cli import main as hil
from tests.hil.rig import BASE, MODEL, MODULES, PLACED, SKIN, PressedSkin, write_session
from tests.rig.commands import printed, refused
from tests.rig.configurations import configuration
from tests.rig.virtual_hub import VirtualHub

pytestmark = pytest.mark.check

OBJECT = [f"{value!r}" for value in PLACED.tolist()]
DEADLINE_S = 120.0


def read(path: Path) -> Calibration:
    config = SkinConfig(calibration=str(path))
    found = calibration_file.load(config, SKIN, 0.0, recorded=True)  # however old it is
    assert found is not None
    return found


def assert_right(found: Calibration, skin: PressedSkin) -> None:
    off = found.mount - skin.mount
    assert np.hypot(*off[:2]) < 5e-4
    assert abs(off[2]) < np.radians(0.4)
    gain = found.full_scale_counts * found.gain / (skin.full_scale * skin.gain)
    known = found.gain_sd < 0.06
    assert known.sum() > 20
    assert np.median(np.abs(gain[known] - 1.0)) < 0.03


def test_a_session_becomes_a_file_that_serves_its_replay_and_a_text(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    skin = replace(PressedSkin.drawn(MODEL, 11), mount=np.array([0.004, -0.003, 0.05]))
    session, out = tmp_path / "session", tmp_path / "made" / "skin.toml"
    write_session(session, skin, idle_s=25.0, frozen=(13,))

    def off_mm() -> float:
        capsys.readouterr()
        last = json.loads(printed("replay", session).splitlines()[-1])["map"]
        return 1e3 * float(np.hypot(last["x"] - PLACED[0], last["y"] - PLACED[1]))

    without = off_mm()
    assert main(["calibrate", str(session), "--out", str(out), "--object", *OBJECT]) == 0
    assert out.with_suffix(".txt").read_text(encoding="utf-8") in capsys.readouterr().out
    found = read(out)
    assert_right(found, skin)
    assert found.presses == 20
    assert np.flatnonzero(found.frozen).tolist() == [13]
    assert np.median(found.noise_counts) == pytest.approx(20.0, rel=0.15)
    with (session / "config.toml").open("a", encoding="utf-8") as config:
        config.write('[skin]\ncalibration = "../made/skin.toml"\n')
    assert off_mm() < 0.5 * without


def test_a_session_without_a_robot_or_without_rest_is_refused(tmp_path: Path) -> None:
    skin = PressedSkin.drawn(MODEL, 11)
    session, out = tmp_path / "session", ["--out", tmp_path / "c.toml"]
    write_session(session, replace(skin, sensor=skin.sensor[:2]), idle_s=4.0)
    says = refused("calibrate", session, *out)
    assert re.search("seconds untouched at first: [34]; it takes at least 10; touch nothing", says)
    (session / "sensor_pose.csv").unlink()
    says = refused("calibrate", session, *out)
    assert "sensor_pose.csv: is missing; a calibration needs" in says
    assert not out[1].exists()


def test_a_skin_that_is_pressed_now_is_guided_recorded_and_fitted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(calibrate, "LEAST_IDLE_S", 1.0)
    skin = PressedSkin.drawn(MODEL, 4, presses=18)
    uids = [uid for module in MODULES for uid in module.uids]
    index = {int(uid): i for i, uid in enumerate(SKIN.uid)}
    taxel = np.array([index.get(uid, -1) for uid in uids])
    said: list[str] = []
    with VirtualHub(tmp_path / "skin", MODULES) as hub, zmq.Context() as context:
        robot = context.socket(zmq.PUB)
        robot.bind(f"ipc://{tmp_path}/poses")
        few = {"proposal": "manifold", "particles": 40, "particles_max": 40, "injected": 10}
        config = configuration(
            tmp_path,
            source=hub.source | {"period_ms": 20},
            filter=few,
            sensor_pose={"endpoint": f"ipc://{tmp_path}/poses"},
        )
        out = tmp_path / "skin.toml"
        asking = Guided(load(config), config, out, 1.5, 16, said.append)
        ended: list[bool] = []
        worker = threading.Thread(target=lambda: ended.append(asking.run()))
        worker.start()
        away, rng = np.array([0.6, 0.6, 0.0]), np.random.default_rng(0)
        moves = [pose for told in skin.told for pose in (told, away)]
        at, next_s, next_pose_s = away, np.inf, 0.0
        begun_s = time.monotonic()
        while worker.is_alive() and time.monotonic() < begun_s + DEADLINE_S:
            now_s = time.monotonic()
            if next_s == np.inf and any(line.startswith("2. press") for line in said):
                next_s = now_s
            if now_s >= next_s and moves:
                pressing = len(moves) % 2 == 0
                at, next_s = moves.pop(0), now_s + (0.5 if pressing else 0.25)
            if now_s >= next_pose_s:
                next_pose_s = now_s + 0.01
                x, y, theta = at.tolist()
                pose = {"t": time.time(), "x": x, "y": y, "theta": theta}
                robot.send_multipart([topics.SENSOR_POSE, msgpack.packb(pose), b"0"])

            def counts(_: int, at: np.ndarray = at) -> list[int]:
                pressed = skin.counts(se2.compose(at, skin.mount)[None])[0]
                noisy = BASE + pressed + skin.noise * rng.standard_normal(len(pressed))
                return np.round(np.where(taxel >= 0, noisy[taxel], 12_000.0)).astype(int).tolist()

            hub.serve(now_s, counts)
            time.sleep(0.001)
        asking.stop()
        worker.join(DEADLINE_S)
        robot.close(0)
    assert ended == [True], "\n".join(said)
    assert said[0].startswith("1. touch nothing for 2 s")
    assert any(line.startswith("   16 of 16; next with the skin's side at ") for line in said)
    # another attempt has a session of its own
    place = Guided(load(config), config, out, 1.5, 16, said.append).directory
    assert place != asking.directory
    result = calibrate.of_session(asking.directory, load(config), PLACED)
    assert abs(result.calibration.t - time.time()) < 3600.0
    assert_right(result.calibration, skin)


RECORDED = Path(__file__).parents[1] / "daemon" / "session"


def test_twelve_touches_doubt_most_wrong_full_scales_and_no_right_one(tmp_path: Path) -> None:
    wrong, twelve = 0, tmp_path / "twelve.toml"
    twelve.write_text('bundle = "box"\ncontacts = 12\n', encoding="utf-8")
    for seed in range(4):
        session = tmp_path / str(seed)
        line = ["run", str(twelve), "--clock", "fake", "--seed", str(seed)]
        assert hil([*line, "--out", str(session)]) == 0
        assert main(["calibrate", str(session), "--check"]) == 0
        config = session / "config.toml"
        text = config.read_text(encoding="utf-8")
        config.write_text(text.replace("counts = 20000.0", "counts = 50000.0"), encoding="utf-8")
        # 2: it may leave no pose to judge by
        wrong += main(["calibrate", str(session), "--check"]) == 1
    assert wrong > 2


def test_the_check_refuses_few_touches_and_a_skin_without_an_object() -> None:
    config = load(RECORDED / "config.toml")
    with pytest.raises(SetupError, match=r"touches: \d; it takes at least 5; touch the object"):
        check.of_session(RECORDED, config)
    with pytest.raises(SetupError, match=r"scene\.bundle: is empty"):
        check.of_session(RECORDED, replace(config, scene=SceneConfig()))
