"""A session that was cut anywhere replays up to its last whole record, and one of another time is
read by what its format says."""

import json
import logging
import os
import shutil
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from taxeld.commands.replay import open_pipeline, outcomes
from taxeld.config.tables import Config, SensorPoseConfig
from taxeld.errors import SetupError
from taxeld.pipeline.pipeline import Pipeline
from taxeld.proposals import bundle, choice
from taxeld.proposals.bundle import Bundle
from taxeld.source import session
from taxeld.source.recorder import Recorder
from taxeld.stream import messages
from taxeld_protocol import cyskin, serial_link
from taxeld_protocol.frames import Chunk, Frame
from taxeld_protocol.virtual_ihb import VirtualIhb
from tests.rig.commands import refused
from tests.rig.configurations import config, configuration
from tests.rig.sessions import read
from tests.rig.skins import CHANNELS, MODULES, SKIN
from tests.rig.virtual_hub import told

PERIOD_S = 0.05
SOURCES = {
    "can": {"kind": "can", "channel": "can0"},
    "native": {"kind": "serial", "channel": "tty"},
}
NAME = "003_cracker_box"
SCANS = 32  # of them 20 make the baseline
INPUT = {session.FRAMES, session.SERIAL, session.SERIAL_TIMES, session.ABOUT}


@cache
def box() -> Bundle:
    return bundle.load("box", SKIN, 0.005)


def config_of(transport: str) -> Config:
    few = {"proposal": "manifold", "particles": 50, "particles_max": 50, "injected": 20}
    robot = {"endpoint": "tcp://127.0.0.1:9"}
    return config(source=SOURCES[transport], filter=few, sensor_pose=robot)


def sent(transport: str) -> Iterator[Frame | Chunk]:
    """What a hub tells of its modules, and idle, touched and idle scans, as they come over the
    wire; a line is read in odd pieces."""
    hub, rng = VirtualIhb(MODULES), np.random.default_rng(0)
    for scan in range(SCANS):
        counts = 1000 + rng.normal(0.0, 20.0, CHANNELS)
        counts[36:44] += 8000.0 * (SCANS - 8 <= scan < SCANS - 3)
        line = b""
        answers = [*([] if scan else told(hub)), *hub.sensor_data(counts.astype(int).tolist())]
        for command, payload in answers:
            frames = cyskin.to_frames(command, payload, ihb=1, t=100.0 + scan * PERIOD_S)
            if transport == "can":
                yield from frames
            else:
                line += serial_link.encode(command, payload, ihb=1)
        for start in range(0, len(line), 97):
            t = 100.0 + scan * PERIOD_S + 1e-5 * start
            yield Chunk(t, line[start : start + 97])


def record(place: Path, transport: str) -> None:
    with Recorder(place, moves=True) as recorder:
        for item in sent(transport):
            recorder.take(item)
        for k in range(20 + round(100 * SCANS * PERIOD_S)):
            recorder.pose(99.9 + 0.01 * k, 0.001 * k, -0.002, 0.01 * k)


def estimates(place: Path, transport: str) -> list[str]:
    settings_ = config_of(transport)
    samples = choice.samples([box()], settings_.filter)
    pipeline = Pipeline(settings_, [SKIN], [box().model], samples)
    why = pipeline.freshness.why
    return [
        json.dumps(messages.estimate(o.estimate, names=[NAME], seq=seq, why=why(o.estimate)))
        for seq, o in enumerate(outcomes(place, pipeline))
    ]


@pytest.fixture(scope="module", params=list(SOURCES))
def recorded(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[str, Path, list[str]]:
    """A transport, a session over it, and the estimates of that."""
    place = tmp_path_factory.mktemp("sessions") / "whole"
    record(place, request.param)
    whole = estimates(place, request.param)
    assert len(whole) == SCANS
    assert json.loads(whole[-1])["contacts"] == 1
    return request.param, place, whole


@given(data=st.data())
@settings(
    max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_a_session_that_is_cut_at_any_byte_of_any_file_replays_to_where_it_was_cut(
    recorded: tuple[str, Path, list[str]], caplog: pytest.LogCaptureFixture, data: st.DataObject
) -> None:
    transport, place, whole = recorded
    copy = place.with_name("cut")
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(place, copy)
    names = sorted(path.name for path in place.iterdir())
    cuts = data.draw(st.lists(st.sampled_from(names), min_size=1, unique=True))
    lost = 0
    for name in cuts:
        content = (place / name).read_bytes()
        keep = data.draw(st.integers(0, len(content)))
        (copy / name).write_bytes(content[:keep])
        lost += len(content) - keep
    caplog.clear()
    found = estimates(copy, transport)
    if set(cuts) <= INPUT:
        assert found == whole[: len(found)]
    assert len(found) <= len(whole)
    assert len(caplog.messages) == bool(lost)


def test_a_cut_costs_the_end_alone(recorded: tuple[str, Path, list[str]]) -> None:
    """Three quarters of the frames, or of the bytes, or of the rows, give that share of scans."""
    transport, place, whole = recorded
    for name in {session.FRAMES, session.SERIAL, session.SERIAL_TIMES}:
        if not (place / name).exists():
            continue
        copy = place.with_name("three quarters")
        shutil.copytree(place, copy)
        content = (place / name).read_bytes()
        (copy / name).write_bytes(content[: 3 * len(content) // 4])
        found = estimates(copy, transport)
        shutil.rmtree(copy)
        assert found == whole[: len(found)]
        assert 0.7 * SCANS <= len(found) <= 0.75 * SCANS


def test_a_number_that_was_cut_is_no_number(tmp_path: Path) -> None:
    path = tmp_path / session.POSES
    path.write_text("t,x,y,theta\n1.0,0.1,0.2,0.3\n2.0,0.1,0.2,0.312", encoding="ascii")
    assert session.read_poses(path) == [(1.0, 0.1, 0.2, 0.3)]


def test_zeros_that_a_power_cut_left_at_the_end_are_no_record(tmp_path: Path) -> None:
    """As file systems do that have stored a file's length before what is in it."""
    record(tmp_path, "can")
    whole = read(tmp_path)
    for name in (session.FRAMES, session.POSES, session.ABOUT):
        with (tmp_path / name).open("ab") as file:
            file.write(bytes(4096))
    assert read(tmp_path) == whole


@pytest.mark.parametrize(
    ("name", "row"), [(session.FRAMES, b"(1.0) can0 1"), (session.POSES, b"1.5,0.2")]
)
def test_damage_that_is_not_at_the_end_is_an_error_with_its_line(
    tmp_path: Path, name: str, row: bytes
) -> None:
    record(tmp_path, "can")
    lines = (tmp_path / name).read_bytes().splitlines(keepends=True)
    (tmp_path / name).write_bytes(b"".join([*lines[:7], row, b"\n", *lines[7:]]))
    with pytest.raises(SetupError, match=f"{name}: line 8 is "):
        read(tmp_path)


@pytest.mark.parametrize("name", [session.FRAMES, session.POSES, session.ABOUT])
def test_a_line_without_end_is_one_line_of_error_and_takes_no_memory(
    tmp_path: Path, name: str
) -> None:
    record(tmp_path, "can")
    with (tmp_path / name).open("ab") as file:
        file.write(b"0" * 5000)
        file.truncate(1 << 36)  # a file with a hole; more than there is memory
    with pytest.raises(SetupError, match=rf"{name}: damaged \(line \d+ is longer than 4096 bytes"):
        read(tmp_path)


@pytest.mark.parametrize(
    ("transport", "name"),
    [
        ("can", session.FRAMES),
        ("can", session.POSES),
        ("native", session.SERIAL),
    ],
)
def test_a_pipe_in_place_of_a_file_of_a_session_keeps_nobody_waiting(
    tmp_path: Path, transport: str, name: str
) -> None:
    record(tmp_path, transport)
    (tmp_path / name).unlink()
    os.mkfifo(tmp_path / name)
    with pytest.raises(SetupError, match=f"{name}: unreadable .it is no regular file"):
        read(tmp_path)


def test_a_whole_session_says_nothing(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    record(tmp_path, "native")
    read(tmp_path)
    assert caplog.messages == []


def test_a_session_without_a_version_is_read_as_the_first(tmp_path: Path) -> None:
    record(tmp_path, "native")
    before = read(tmp_path)
    (tmp_path / session.ABOUT).unlink()
    assert read(tmp_path) == before


@pytest.mark.parametrize(
    ("about", "fault"),
    [
        ("version = 3\n", "is of version 3"),
        ('bytes = "9"\n', "damaged"),
        (f"bytes = {'9' * 5000}\n", "damaged"),
        (f"version = 0x{'f' * 9999}\n", "damaged"),
        ("frames = " + "[" * 100_000 + "\n", "damaged"),
    ],
)
def test_a_session_of_a_newer_version_is_refused_in_one_line(
    tmp_path: Path, about: str, fault: str
) -> None:
    record(tmp_path, "can")
    (tmp_path / session.ABOUT).write_text(about, encoding="ascii")
    configuration(tmp_path, source=SOURCES["can"])
    assert refused("replay", tmp_path).startswith(f"{tmp_path}/{session.ABOUT}: {fault}")


def test_recorded_poses_are_used_whatever_the_configuration_says_of_an_endpoint(
    tmp_path: Path,
) -> None:
    record(tmp_path, "can")
    config = config_of("can")
    without = replace(config, sensor_pose=SensorPoseConfig())
    found = [
        [outcome.sensor for outcome in outcomes(tmp_path, open_pipeline(tmp_path, settings_))]
        for settings_ in (config, without)
    ]
    seen = [pose for pose in found[1] if pose is not None]
    assert np.ptp([pose[0] for pose in seen]) > 0.01
    np.testing.assert_equal(found[0], found[1])


def test_where_no_pose_was_recorded_the_sensor_stands_still(tmp_path: Path) -> None:
    with Recorder(tmp_path, moves=False) as recorder:
        for item in sent("can"):
            recorder.take(item)
    pipeline = open_pipeline(tmp_path, config_of("can"))
    assert all(o.sensor is None or not o.sensor.any() for o in outcomes(tmp_path, pipeline))
    assert pipeline.estimate.contacts == 1
