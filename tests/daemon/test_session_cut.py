"""A session that was cut anywhere replays up to its last whole record, and one of another time is
read by what its format says."""

import os
import re
import shutil
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from taxeld.commands.replay import open_pipeline, outcomes
from taxeld.config.tables import Config, SensorPoseConfig
from taxeld.errors import SetupError
from taxeld.source import session
from taxeld.source.recorder import Recorder
from taxeld.source.session import Item
from taxeld_hil.rig.virtual_ihb import VirtualIhb
from taxeld_protocol import cyskin, serial_link
from taxeld_protocol.array import FULL, REST, ArrayFrame
from taxeld_protocol.frames import Chunk, Frame
from tests.rig.configurations import config
from tests.rig.sessions import poses_of, read
from tests.rig.skins import CHANNELS, MODULES, SKIN
from tests.rig.virtual_hub import told

PERIOD_S = 0.05
SOURCES = {
    "can": {"kind": "can", "channel": "can0"},
    "native": {"kind": "serial", "channel": "tty"},
}
SCANS = 32  # of them 20 make the baseline
Change = Callable[[Path], object]
STRIDE = 7  # bytes from cut to cut, which no line has as its length


def config_of(transport: str) -> Config:
    few = {"proposal": "manifold", "particles": 50, "particles_max": 50, "injected": 20}
    robot = {"endpoint": "tcp://127.0.0.1:9"}
    return config(source=SOURCES[transport], filter=few, sensor_pose=robot)


def sent(transport: str, scans: int = SCANS) -> Iterator[Item]:
    """What a hub tells of its modules, and idle, touched and idle scans, as they come over the
    wire; a line is read in odd pieces. Of an array: its frames."""
    hub, rng = VirtualIhb(MODULES), np.random.default_rng(0)
    for scan in range(scans):
        t = 100.0 + scan * PERIOD_S
        if transport == "array":
            z = (REST + rng.integers(1, FULL, len(SKIN))).tolist()
            yield ArrayFrame(t, "arm", REST, (0, *z[1:]))  # a taxel that was not read
            continue
        counts = 1000 + rng.normal(0.0, 20.0, CHANNELS)
        counts[36:44] += 8000.0 * (scans - 8 <= scan < scans - 3)
        line = b""
        answers = [*([] if scan else told(hub)), *hub.sensor_data(counts.astype(int).tolist())]
        for command, payload in answers:
            if transport == "can":
                yield from cyskin.to_frames(command, payload, ihb=1, t=t)
            else:
                line += serial_link.encode(command, payload, ihb=1)
        for start in range(0, len(line), 97):
            yield Chunk(t + 1e-5 * start, line[start : start + 97])


def record(
    place: Path, transport: str, scans: int = SCANS, poses: int | None = 20 + 5 * SCANS
) -> None:
    with Recorder(place, moves=poses is not None) as recorder:
        for item in sent(transport, scans):
            recorder.take(item)
        for k in range(poses or 0):
            recorder.pose(99.9 + 0.01 * k, 0.001 * k, -0.002, 0.01 * k)


@pytest.mark.parametrize("transport", ["can", "native", "array"])
def test_a_recording_that_is_cut_anywhere_has_all_that_stands_before_the_cut(
    tmp_path: Path, transport: str, caplog: pytest.LogCaptureFixture
) -> None:
    """And one line says what is missing."""
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    record(whole, transport, scans=2, poses=3)
    items, poses = read(whole)
    assert caplog.messages == []
    shutil.copytree(whole, cut)
    for path in sorted(whole.iterdir()):
        content = path.read_bytes()
        for size in [*range(0, len(content), STRIDE), len(content) - 1]:
            (cut / path.name).write_bytes(content[:size])
            caplog.clear()
            found, found_poses = read(cut)
            lines = content[:size].count(b"\n")
            left = {session.FRAMES: lines, session.ARRAY: lines, session.SERIAL_TIMES: lines - 2}
            used = max(left.get(path.name, len(items)), 0)
            if path.name == session.SERIAL:
                data = b"".join(c.data for c in found if isinstance(c, Chunk))
                assert data == content[:size], "up to the last byte"
            else:  # the end of a line's last bytes is known where session.toml is whole
                assert found in (items[:used], items[: used - (path.name == session.ABOUT)])
            rows = max(lines - 1, 0) if path.name == session.POSES else len(poses)
            assert found_poses == poses[:rows]
            (message,) = caplog.messages
            assert message.startswith(f"{cut}: the recording was cut; used are ")
            assert f"{lines} of {len(items)} " in message or path.name != session.FRAMES
        (cut / path.name).write_bytes(content)


def test_a_session_of_any_length_takes_the_same_memory(tmp_path: Path) -> None:
    frames = b"(1000.000000) can0 101#431A000027102711\n" * 20_000
    poses = b"t,x,y,theta\n" + b"1000.0,0.1,0.2,0.3\n" * 20_000
    content((session.FRAMES, frames), (session.POSES, poses))(tmp_path)
    tracemalloc.start()
    assert sum(1 for _ in session.records(tmp_path)) == 40_000
    assert tracemalloc.get_traced_memory()[1] < 1 << 20
    tracemalloc.stop()


def test_what_came_of_several_links_stands_in_one_session_and_comes_back_in_order(
    tmp_path: Path,
) -> None:
    """Also where a bus, two lines and an array are mixed, and the clock is set back."""
    pose = (1.4, 0.1, -0.2, 3.0)
    came: list[tuple[Item, int]] = [
        (Frame(1.25, 0x101, b"\x43\x00"), 0),
        (Chunk(1.3, b"abc"), 1),
        ((1.35, *pose[1:]), 0),
        (Chunk(1.375, b"d"), 3),
        (pose, 2),
        (Frame(1.5, 0x18DAF110, b"", True), 4),
        (ArrayFrame(1.6, "arm", 0, (1, 2)), 0),
        (Chunk(1.7, b"ef"), 1),
    ]
    later = [(item._replace(t=item.t - 1.0), k) for item, k in came if isinstance(item, Frame)]
    with Recorder(tmp_path, moves=True, links=5) as recorder:
        for item, link in [*came, *later]:
            recorder.take(item, link)
    found = list(session.records(tmp_path))
    assert [(each.item, each.link) for each in found] == [*came, *later]
    assert [each.steps for each in found] == [0] * len(came) + [1] * len(later)
    assert session.begun(tmp_path) == 1.25
    assert poses_of(tmp_path, 2) == [pose]


@pytest.mark.parametrize("transport", ["can", "native"])
def test_zeros_that_a_power_cut_left_at_the_end_are_no_record(
    tmp_path: Path, transport: str
) -> None:
    """As file systems do that have stored a file's length before what is in it."""
    record(tmp_path, transport)
    whole = read(tmp_path)
    for path in tmp_path.iterdir():
        path.write_bytes(path.read_bytes() + bytes(4096))
    assert read(tmp_path) == whole


def changed(name: str, of: Callable[[bytes], bytes]) -> Change:
    return lambda place: (place / name).write_bytes(of((place / name).read_bytes()))


def row(name: str, line: bytes) -> Change:
    """A line among those of a file."""
    return changed(name, lambda data: re.sub(rb"\A(?:.*\n){7}", lambda m: m[0] + line, data))


def content(*files: tuple[str, bytes]) -> Change:
    return lambda place: [(place / name).write_bytes(text) for name, text in files]


def endless(name: str) -> Change:
    """A line that ends nowhere, in a file with a hole: more than there is memory."""
    ends = changed(name, lambda data: data + b"0" * 5000)
    return lambda place: (ends(place), os.truncate(place / name, 1 << 36))


def pipe(name: str) -> Change:
    return lambda place: ((place / name).unlink(), os.mkfifo(place / name))


READ = (session.FRAMES, session.POSES, session.ABOUT)


@pytest.mark.parametrize(
    ("transport", "change", "fault"),
    [
        ("can", row(session.FRAMES, b"(1.0) can0 1\n"), "frames.log: line 8 is no candump line"),
        ("can", row(session.POSES, b"1.5,0.2\n"), "pose.csv: line 8 is not t,x,y,theta"),
        ("can", row(session.POSES, b"1.5,nan,0,0\n"), "pose.csv: line 8 is not t,x,y,theta"),
        ("array", row(session.ARRAY, b"[]\n"), "jsonl: line 8 is no array .it is no map"),
        ("native", row(session.SERIAL_TIMES, b"t,row\n"), "csv: line 8 is not t,offset"),
        ("native", row(session.SERIAL_TIMES, b"2.0,nine\n"), "csv: line 8 is not t,offset"),
        ("native", row(session.SERIAL_TIMES, b"2.0,3\n"), "its offsets do not begin at 0, or fa"),
        (
            "native",
            content((session.SERIAL_TIMES, b"t,row\n")),
            "must begin with the line t,offset",
        ),
        ("native", content((session.SERIAL_TIMES, b"t,offset\n1.0,5\n")), "do not begin at 0"),
        (
            "none",
            content((session.SERIAL, bytes(20)), (session.SERIAL_TIMES, b"t,offset\n")),
            "holds no frames, it is empty",
        ),
        ("can", content((session.ABOUT, b"version = 3\n")), "session.toml: is of version 3"),
        ("can", content((session.ABOUT, b'bytes = "9"\n')), "session.toml: damaged"),
        *(("can", endless(name), f"{name}: damaged .line .* is longer than 4096") for name in READ),
        *(("can", pipe(name), f"{name}: unreadable .it is no regular file") for name in READ),
    ],
)
def test_damage_that_is_not_at_the_end_is_one_line_that_names_its_place(
    tmp_path: Path, transport: str, change: Change, fault: str
) -> None:
    if transport != "none":
        record(tmp_path, transport)
    change(tmp_path)
    with pytest.raises(SetupError, match=rf"^{tmp_path}.*{fault}[^\n]*$"):
        read(tmp_path)


def test_a_session_without_a_version_is_read_as_the_first(tmp_path: Path) -> None:
    record(tmp_path, "native")
    before = read(tmp_path)
    (tmp_path / session.ABOUT).unlink()
    assert read(tmp_path) == before


def test_recorded_poses_are_used_whatever_the_configuration_says_of_an_endpoint(
    tmp_path: Path,
) -> None:
    record(tmp_path, "can")
    with_one = config_of("can")
    found = [
        [outcome.sensor for outcome in outcomes(tmp_path, open_pipeline(tmp_path, each))]
        for each in (with_one, replace(with_one, sensor_pose=SensorPoseConfig()))
    ]
    assert np.ptp([pose[0] for pose in found[1] if pose is not None]) > 0.01
    np.testing.assert_equal(found[0], found[1])


def test_where_no_pose_was_recorded_the_sensor_stands_still(tmp_path: Path) -> None:
    record(tmp_path, "can", poses=None)
    assert not (tmp_path / session.POSES).exists()
    pipeline = open_pipeline(tmp_path, config_of("can"))
    assert all(o.sensor is None or not o.sensor.any() for o in outcomes(tmp_path, pipeline))
    assert pipeline.estimate.contacts == 1
