"""`taxeld calibrate`: of a session, of a skin that is pressed now, and the check of a session."""

import json
import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest

from taxeld.cli import main
from taxeld.commands import record
from taxeld.commands.replay import RecordedSource
from taxeld.config.file import load
from taxeld.config.tables import Config, SceneConfig, SkinConfig
from taxeld.errors import SetupError
from taxeld.service import calibration_file
from taxeld.skin.calibration import Calibration
from taxeld.source import session
from taxeld_hil.calibration import check, command
from taxeld_hil.calibration.command import Guided
from taxeld_hil.cli import main as hil
from taxeld_protocol.decoder import Scan
from taxeld_protocol.frames import Frame
from tests.hil.accept_skin import SleepClock
from tests.hil.rig import MODEL, PLACED, SKIN, PressedSkin, write_session
from tests.rig.commands import printed, refused
from tests.rig.configurations import configuration

pytestmark = pytest.mark.check

OBJECT = [f"{value!r}" for value in PLACED.tolist()]


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
    place, out = tmp_path / "session", tmp_path / "made" / "skin.toml"
    write_session(place, skin, idle_s=25.0, frozen=(13,))

    def off_mm() -> float:
        capsys.readouterr()
        last = json.loads(printed("replay", place).splitlines()[-1])["map"]
        return 1e3 * float(np.hypot(last["x"] - PLACED[0], last["y"] - PLACED[1]))

    without = off_mm()
    assert main(["calibrate", str(place), "--out", str(out), "--object", *OBJECT]) == 0
    assert out.with_suffix(".txt").read_text(encoding="utf-8") in capsys.readouterr().out
    found = read(out)
    assert_right(found, skin)
    assert found.presses == 20
    assert np.flatnonzero(found.frozen).tolist() == [13]
    assert np.median(found.noise_counts) == pytest.approx(20.0, rel=0.15)
    with (place / "config.toml").open("a", encoding="utf-8") as config:
        config.write('[skin]\ncalibration = "../made/skin.toml"\n')
    assert off_mm() < 0.5 * without


def test_a_session_without_a_robot_or_without_rest_is_refused(tmp_path: Path) -> None:
    skin = PressedSkin.drawn(MODEL, 11)
    place, out = tmp_path / "session", ["--out", tmp_path / "c.toml"]
    write_session(place, replace(skin, sensor=skin.sensor[:2]), idle_s=4.0)
    says = refused("calibrate", place, *out)
    assert re.search("seconds untouched at first: [34]; it takes at least 10; touch nothing", says)
    (place / "sensor_pose.csv").unlink()
    says = refused("calibrate", place, *out)
    assert "sensor_pose.csv: is missing; a calibration needs" in says
    assert not out[1].exists()


class PlayedInputs:
    """Inputs to which a recorded session comes, a record a look; the clock goes along."""

    def __init__(
        self, place: Path, clock: SleepClock, config: Config, skins: Any, link: Any, recorder: Any
    ) -> None:
        self.sources = [SimpleNamespace(decoder=None)]
        self._clock, self._link, self._recorder = clock, link, recorder
        self._records = session.records(place)
        self._source = RecordedSource(place, config.source, {0: skins[0]}, alone=True)

    def poll(self, _: float) -> list[Scan]:
        record = next(self._records)
        self._clock.now = record.t
        if isinstance(record.item, Frame):
            self._recorder.take(record.item)
            return self._source.take(record)
        self._link._on_pose(*record.item, 0)
        return []

    def close(self) -> None:
        """Nothing is held open."""


def test_a_skin_that_is_pressed_now_is_guided_recorded_and_fitted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    skin, clock = PressedSkin.drawn(MODEL, 4, presses=18), SleepClock(100.0)
    write_session(tmp_path / "pressed", skin)  # from 100 s on
    monkeypatch.setattr(command, "IDLE_S", 10.0)
    monkeypatch.setattr(command, "PRESSES", 16)
    monkeypatch.setattr(command, "signal", MagicMock())
    monkeypatch.setattr(command, "time", clock)
    monkeypatch.setattr(record, "time", clock)
    monkeypatch.setattr(record, "Inputs", partial(PlayedInputs, tmp_path / "pressed", clock))
    few = {"proposal": "manifold", "particles": 40, "particles_max": 40, "injected": 10}
    config = configuration(tmp_path, filter=few, sensor_pose={"endpoint": "ipc:///nowhere"})
    out = tmp_path / "skin.toml"
    line = ["calibrate", str(config), "--out", str(out), "--object", *OBJECT]
    assert main(line) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("1. touch nothing for 10 s")
    assert any(line.startswith("2. press the object 16 times") for line in said)
    assert any(line.startswith("   16 of 16; next with the skin's side at ") for line in said)
    assert_right(read(out), skin)
    # another attempt has a session of its own
    place = Guided(load(config), config, out).directory
    assert (place.name, (tmp_path / "skin.session").is_dir()) == ("skin.session-2", True)


RECORDED = Path(__file__).parents[1] / "daemon" / "session"


def test_twelve_touches_doubt_most_wrong_full_scales_and_no_right_one(tmp_path: Path) -> None:
    wrong, twelve = 0, tmp_path / "twelve.toml"
    twelve.write_text('bundle = "box"\ncontacts = 12\n', encoding="utf-8")
    for seed in range(4):
        place = tmp_path / str(seed)
        line = ["run", str(twelve), "--clock", "fake", "--seed", str(seed)]
        assert hil([*line, "--out", str(place)]) == 0
        assert main(["calibrate", str(place), "--check"]) == 0
        config = place / "config.toml"
        text = config.read_text(encoding="utf-8")
        config.write_text(text.replace("counts = 20000.0", "counts = 50000.0"), encoding="utf-8")
        # 2: it may leave no pose to judge by
        wrong += main(["calibrate", str(place), "--check"]) == 1
    assert wrong > 2


def test_the_check_refuses_few_touches_and_a_skin_without_an_object() -> None:
    config = load(RECORDED / "config.toml")
    with pytest.raises(SetupError, match=r"touches: \d; it takes at least 5; touch the object"):
        check.of_session(RECORDED, config)
    with pytest.raises(SetupError, match=r"scene\.bundle: is empty"):
        check.of_session(RECORDED, replace(config, scene=SceneConfig()))
