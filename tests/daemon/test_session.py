"""A session is read up to its last whole record, and its replay sees what the loop saw."""

import csv
import math
import os
import tracemalloc
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import msgpack
import numpy as np
import pytest

from taxeld.commands.replay import open_pipeline, outcomes
from taxeld.config.tables import Config, SensorPoseConfig, SourceConfig
from taxeld.errors import SetupError
from taxeld.source import session
from taxeld.source.recorder import Recorder
from taxeld.source.session import (
    ARRIVALS,
    VERSION,
    Arrival,
    ClockStep,
    Head,
    Item,
    Late,
    Pass,
    SensorPose,
    packed,
)
from taxeld.source.sources import ArraySource
from taxeld_hil.rig.virtual_ihb import VirtualIhb
from taxeld_protocol import cyskin, serial_link
from taxeld_protocol.array import FULL, REST, ArrayFrame
from taxeld_protocol.frames import Chunk, Frame, parse_log_line
from tests.rig.clocks import Clock
from tests.rig.commands import printed, refused
from tests.rig.configurations import config, configuration
from tests.rig.sessions import recorded_inputs, write
from tests.rig.skins import CHANNELS, MODULES, SKIN
from tests.rig.virtual_hub import told

PERIOD_S = 0.05
SOURCES = {
    "can": {"kind": "can", "channel": "can0"},
    "native": {"kind": "serial", "channel": "tty"},
}
SCANS = 32  # of them 20 make the baseline
STRIDE = 5  # bytes from cut to cut, which no record has as its length
HEAD = Head(VERSION, moves=True, modules={0: ((7, 0xFFF),), 4: ()})


def config_of(transport: str) -> Config:
    few = {"proposal": "manifold", "particles": 50, "particles_max": 50, "injected": 20}
    robot = {"endpoint": "tcp://127.0.0.1:9"}
    return config(source=SOURCES[transport], filter=few, sensor_pose=robot)


def sent(transport: str, scans: int = SCANS) -> Iterator[Frame | Chunk | ArrayFrame]:
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


def poses() -> Iterator[SensorPose]:
    """Of a robot that moves, from before the first scan to after the last."""
    for k in range(20 + 5 * SCANS):
        yield SensorPose(99.9 + 0.01 * k, 0.001 * k, -0.002, 0.01 * k)


def story() -> list[Arrival]:
    """One of each kind, over several links, across a clock that was set back."""
    came: list[tuple[Item, int]] = [
        (Frame(1.25, 0x101, b"\x43\x00"), 0),
        (Chunk(1.3, b"abc"), 1),
        (SensorPose(1.1, 0.1, -0.2, 3.0), 0),
        (Pass(1.4), 0),
        (ClockStep(1.4, -1.0), 0),
        (Chunk(0.375, b""), 3),
        (SensorPose(7.0, math.nan, 0.0, 0.0), 2),
        (Frame(0.5, 0x18DAF110, b"", True), 4),
        (Late(0.5), 4),
        (ArrayFrame(0.6, "arm", 0, (1, 2, 0)), 0),
    ]
    return [Arrival(item.t, link, item) for item, link in came]


@pytest.fixture
def whole(tmp_path: Path) -> bytes:
    """The file of the story."""
    with Recorder(tmp_path, moves=True, modules=HEAD.modules) as recorder:
        for t, link, item in story():
            assert not isinstance(item, Head)
            recorder.take(item, link, t)
    return (tmp_path / ARRIVALS).read_bytes()


def test_a_recording_that_is_cut_anywhere_has_all_that_stands_before_the_cut(
    tmp_path: Path, whole: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    """And one line says what is missing. Zeros, which a power cut may leave, are no record."""
    ends = np.cumsum([len(packed(each)) for each in (Arrival(1.25, 0, HEAD), *story())])
    assert ends[-1] == len(whole)
    assert repr([*session.arrivals(tmp_path)]) == repr(story())  # nan is not nan
    assert session.head(tmp_path) == (1.25, HEAD)
    assert caplog.messages == []
    for size in range(ends[2], len(whole), STRIDE):
        for zeros in (0, 4096):
            caplog.clear()
            (tmp_path / ARRIVALS).write_bytes(whole[:size] + bytes(zeros))
            count = int((ends <= size).sum()) - bool(zeros)
            found = [*session.arrivals(tmp_path)]
            count += len(found) == count  # the last is doubted, where no other follows
            assert repr(found) == repr(story()[: count - 1])
            of = f"{ends[count - 1]} of its {size + zeros} bytes"
            said = f"{tmp_path}: the recording was cut; used are {count} records, {of}"
            assert caplog.messages == [said] * int(ends[count - 1] < size + zeros)


def test_a_session_of_any_length_takes_the_same_memory(tmp_path: Path) -> None:
    record = packed(Arrival(1e9, 0, Chunk(1e9, bytes(1 << 16))))
    (tmp_path / ARRIVALS).write_bytes(packed(Arrival(1e9, 0, HEAD)) + record * 250)
    tracemalloc.start()
    assert sum(1 for _ in session.arrivals(tmp_path)) == 250
    assert tracemalloc.get_traced_memory()[1] < 1 << 23
    tracemalloc.stop()


NO_VERSION = "is a session of another version of taxeld, or damaged; record it again"
OTHER = packed(Arrival(1.0, 0, replace(HEAD, version=4)))


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        (None, "has no arrivals: it was recorded by an older version of taxeld, or nothing came; "),
        (b"", NO_VERSION),
        (b"(1.0) can0 101#43\n", NO_VERSION),
        (OTHER, NO_VERSION),
        (packed(story()[0]), NO_VERSION),
        (packed(Arrival(1.0, 0, HEAD)), "holds nothing that came, it is empty; record it again"),
        ("pipe", "unreadable .it is no regular file"),
    ],
    ids=["older", "empty", "text", "newer", "headless", "nothing came", "pipe"],
)
def test_what_is_no_session_of_this_version_is_one_line(
    tmp_path: Path, content: bytes | str | None, fault: str
) -> None:
    if isinstance(content, bytes):
        (tmp_path / ARRIVALS).write_bytes(content)
    elif content:
        os.mkfifo(tmp_path / ARRIVALS)
    with pytest.raises(SetupError, match=rf"^{tmp_path}.*{fault}[^\n]*$"):
        list(session.arrivals(tmp_path))


DAMAGED = [
    (math.inf, 0, "pass", b""),
    (1.0, -1, "pass", b""),
    (1.0, "0", "pass", b""),
    (1.0, 0, "none", b""),
    (1.0, 0, "frame", b"\1"),
    (1.0, 0, "frame", bytes(13)),
    (1.0, 0, "pose", bytes(31)),
    (1.0, 0, "step", b"\xff" * 8),
    (1.0, 0, "array", b"[]"),
    (1.0, 0, "head", b"\1"),
    (1.0, 0),
]


@pytest.mark.parametrize("record", DAMAGED, ids=range(len(DAMAGED)))
def test_a_session_is_read_up_to_a_record_that_is_none(
    tmp_path: Path, whole: bytes, record: object, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / ARRIVALS).write_bytes(whole + msgpack.packb(record) + packed(story()[0]))
    """But for the one before: zeros may have filled it."""
    assert repr([*session.arrivals(tmp_path)]) == repr(story()[:-1])
    assert [f"used are {len(story())} records" in line for line in caplog.messages] == [True]


@pytest.mark.parametrize("moves", [True, False])
def test_a_sessions_sensor_moves_where_the_recorder_had_a_robot_whatever_is_configured_now(
    tmp_path: Path, moves: bool
) -> None:
    """Without one it stands still."""
    write(tmp_path, [*poses(), *sent("can")] if moves else sent("can"), moves=moves)
    with_one = config_of("can")
    found = []
    for each in (with_one, replace(with_one, sensor_pose=SensorPoseConfig())):
        pipeline = open_pipeline(tmp_path, each)
        found.append([outcome.sensor for outcome in outcomes(tmp_path, pipeline)])
        assert moves or pipeline.estimate.contacts == 1
    np.testing.assert_equal(found[0], found[1])
    assert (np.ptp([pose[0] for pose in found[1] if pose is not None]) > 0.01) == moves


def arrays(count: int) -> list[ArrayFrame]:
    """Some of another id, of a clock that is behind, or an hour ahead."""
    found = [item for item in sent("array", count) if isinstance(item, ArrayFrame)]
    found[3] = found[3]._replace(id="leg")
    found[5] = found[5]._replace(t=found[5].t - 1.0)
    found[7] = found[7]._replace(t=found[7].t + 3600.0)
    return found


def test_an_arrays_replay_takes_and_refuses_what_the_loop_did(tmp_path: Path) -> None:
    """One that is stamped in the future keeps out no others."""
    source_config = SourceConfig("array", endpoint="ipc:///nowhere")
    scans, clock = [], Clock()
    with Recorder(tmp_path, moves=False) as recorder:
        source = ArraySource(source_config, {0: SKIN}, recorder, clock)
        for frame, right in zip(arrays(12), sent("array", 12), strict=True):
            clock.now = right.t + 0.001
            source.hear(frame)
            scans += source.poll(right.t)
    inputs = recorded_inputs(tmp_path, source={"kind": "array", "endpoint": "ipc:///nowhere"})
    for arrival in session.arrivals(tmp_path):
        inputs.take(arrival)
    assert inputs.scans() == scans
    assert len(scans) == 10
    assert inputs.sources[0].decoder.stats() == source.decoder.stats()


def test_a_session_is_exported_once_for_other_tools(tmp_path: Path) -> None:
    place, frames = tmp_path / "session", [*sent("can", 3)]
    listed = [
        *(item._replace(id="a,b") for item in arrays(8)[:1]),
        *poses(),
        *frames,
        *frames[-3:-1],
    ]
    write(place, listed, moves=True)
    configuration(place)
    out = tmp_path / "out"
    said = printed("export", place, "--out", out)
    names = ["arrays.csv", "frames.log", "modules.toml", "poses.csv", "scans.csv"]
    assert said == "".join(f"written: {out / name}\n" for name in names)
    text = {name: (out / name).read_text(encoding="utf-8").splitlines() for name in names}
    assert [parse_log_line(line) for line in text["frames.log"]] == [*frames, *frames[-3:-1]]
    assert " can0 " in text["frames.log"][0]
    rows = {name: [*csv.reader(text[name])][1:] for name in names}
    assert [[*map(float, row)] for row in rows["poses.csv"]] == [[p.t, 0.0, *p] for p in poses()]
    [[t, link, name, *counts]] = rows["arrays.csv"]
    assert (t, link, name, counts[0], len(counts)) == ("100.0", "0", "a,b", "", len(SKIN))
    assert [len(row) for row in rows["scans.csv"]] == [3 + CHANNELS] * 3
    assert [float(row[0]) for row in rows["scans.csv"]] == [100.0, 100.05, 100.1]
    assert "arrays.csv (File exists)" in refused("export", place, "--out", out)
