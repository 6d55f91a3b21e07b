"""`taxeld calibrate`: of a session, of a skin that is pressed now, and the check of a session."""

import json
import re
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
from taxeld.config.tables import Config, SkinConfig
from taxeld.service import calibration_file
from taxeld.source import session
from taxeld.source.session import Pass, SensorPose
from taxeld_hil.calibration import command
from taxeld_hil.calibration.command import Guided
from taxeld_protocol.decoder import Scan
from taxeld_protocol.frames import Frame
from tests.hil.rig import BEGUN_S, MOUNT, SKIN, pressing, write_session
from tests.rig import sessions
from tests.rig.clocks import Clock
from tests.rig.commands import printed, refused
from tests.rig.configurations import configuration

pytestmark = pytest.mark.check

WORLD = pressing(11)[1]
OBJECT = [f"{value!r}" for value in WORLD.truth.tolist()]
FROZEN, CHANNEL = 13, 15  # a taxel, and its channel: each module of ten taxels has a T0 before them


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session of presses."""
    found = tmp_path_factory.mktemp("pressed") / "session"
    write_session(found, pressing(11)[1], idle_s=25.0, frozen=(CHANNEL,))
    return found


def assert_right(path: Path) -> None:
    config = SkinConfig(calibration=str(path))
    found = calibration_file.load(config, SKIN, 0.0, recorded=True)  # however old it is
    assert found is not None
    assert (np.abs(found.mount - MOUNT) < [0.002, 0.002, np.radians(1.5)]).all()
    known = found.gain_sd < 0.06
    off = found.full_scale_counts * found.gain / WORLD.skins[0].full_scale
    assert np.median(np.abs(off[known] - 1.0)) < 0.1
    assert np.flatnonzero(found.frozen).tolist() == [FROZEN]
    assert np.median(found.noise_counts) == pytest.approx(24.0, rel=0.25)


def test_a_session_that_fails_the_check_becomes_a_calibration_with_which_it_passes(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, config = tmp_path / "skin.toml", place / "config.toml"
    text = config.read_text(encoding="utf-8")
    line = ["calibrate", str(place), "--object", *OBJECT]

    def off_mm(skin: str) -> float:
        config.write_text(f"{text}[skin]\n{skin}\n", encoding="utf-8")
        capsys.readouterr()
        last = json.loads(printed("replay", place).splitlines()[-1])["map"]
        return 1e3 * float(np.hypot(last["x"] - WORLD.truth[0], last["y"] - WORLD.truth[1]))

    without = off_mm("full_scale_counts = 50000.0")
    assert main([*line, "--check"]) == 1
    said = capsys.readouterr().out
    assert re.search(r"FAIL +check +full scale: 0\.[34]\d of the 50000 counts", said)
    assert re.search(r"FAIL +check +mount: off by \([345]", said)
    assert main([*line, "--out", str(out)]) == 0
    assert out.with_suffix(".txt").read_text(encoding="utf-8") in capsys.readouterr().out
    assert_right(out)
    assert off_mm(f'calibration = "{out}"') < 0.5 * without
    assert main(["calibrate", str(place), "--check"]) == 0
    config.write_text(text, encoding="utf-8")


def test_a_session_that_lacks_robot_rest_or_presses_is_refused(tmp_path: Path) -> None:
    place, made = tmp_path / "session", tmp_path / "c.toml"
    write_session(place, pressing(11)[1], idle_s=4.0, end_s=8.0)
    says = refused("calibrate", place, "--out", made)
    assert re.search("seconds untouched at first: [34]; it takes at least 10; touch nothing", says)
    assert re.search(
        r"held still: \d; it takes at least 12", refused("calibrate", place, "--check")
    )
    config = place / "config.toml"
    text = config.read_text(encoding="utf-8")
    two = text.replace('bundle = "box"', 'bundles = ["box", "mug"]')
    config.write_text(two, encoding="utf-8")
    assert "scene.bundles: a skin is calibrated by" in refused("calibrate", place, "--check")
    config.write_text(text, encoding="utf-8")
    (place / session.ARRIVALS).unlink()
    sessions.write(place, [Pass(1.0)])
    says = refused("calibrate", place, "--out", made)
    assert f"{place}: has no robot; a calibration needs" in says
    assert not made.exists()


class PlayedInputs:
    """Inputs to which a recorded session comes, a record a look; the clock goes along."""

    def __init__(
        self, place: Path, clock: Clock, config: Config, skins: Any, link: Any, recorder: Any
    ) -> None:
        self.sources = [SimpleNamespace(decoder=None)]
        self._clock, self._link, self._recorder = clock, link, recorder
        self._arrivals, (_, head) = session.arrivals(place), session.head(place)
        self._source = RecordedSource(config.source, {0: skins[0]}, head, alone=True)

    def poll(self, _: float) -> list[Scan]:
        self._clock.now, _, item = arrival = next(self._arrivals)
        if isinstance(item, Frame):
            self._recorder.take(item)
            return self._source.take(arrival)
        if isinstance(item, SensorPose):
            self._link._on_pose(*item, arrival.t, 0)
        return []

    def close(self) -> None:
        """Nothing is held open."""


def test_a_skin_that_is_pressed_now_is_guided_recorded_and_fitted(
    place: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    clock = Clock(BEGUN_S)
    time = SimpleNamespace(time=clock, monotonic=clock, sleep=bool)
    monkeypatch.setattr(command, "IDLE_S", 10.0)
    monkeypatch.setattr(command, "PRESSES", 16)
    monkeypatch.setattr(command, "signal", MagicMock())
    monkeypatch.setattr(command, "time", time)
    monkeypatch.setattr(record, "time", time)
    monkeypatch.setattr(record, "Inputs", partial(PlayedInputs, place, clock))
    few = {"proposal": "manifold", "particles": 40, "particles_max": 40, "injected": 10}
    config = configuration(tmp_path, filter=few, sensor_pose={"endpoint": "ipc:///nowhere"})
    out = tmp_path / "skin.toml"
    assert main(["calibrate", str(config), "--out", str(out), "--object", *OBJECT]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("1. touch nothing for 10 s")
    assert any(line.startswith("2. press the object 16 times") for line in said)
    assert any(re.match(r"   16 of 16.*; next with the skin's side at ", line) for line in said)
    assert_right(out)
    # another attempt has a session of its own
    guided = Guided(load(config), config, out).directory
    assert (guided.name, (tmp_path / "skin.session").is_dir()) == ("skin.session-2", True)
