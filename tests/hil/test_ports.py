"""The skin's end of a transport: its device's name, and its listeners, who come and go."""

from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import zmq

from taxeld.errors import SetupError
from taxeld.stream.topics import SENSOR_POSE
from taxeld_hil.rig.bench import Bench
from taxeld_hil.rig.ports import ArrayPort, NativePort
from taxeld_hil.rig.rig import Rig
from taxeld_hil.scenario import scenario
from taxeld_protocol import array
from taxeld_protocol.array import ArrayFrame
from tests.rig.clocks import PATIENCE_S, until
from tests.rig.sockets import Sockets

PATIENCE_MS = int(1e3 * PATIENCE_S)


@pytest.fixture
def sockets() -> Iterator[Sockets]:
    with Sockets() as made:
        yield made


@pytest.fixture
def poses(tmp_path: Path) -> str:
    return f"ipc://{tmp_path}/poses"


@pytest.fixture
def bench(poses: str, tmp_path: Path) -> Iterator[Bench]:
    with closing(Bench(Rig(scenario.load("demo"), 0), tmp_path / "skin", poses)) as made:
        yield made


def hears(bench: Bench, host: zmq.Socket[Any], poses: int = 3) -> None:
    """Have the robot send until a host has heard so many poses from now on."""
    while host.poll(0):
        host.recv_multipart()

    def heard() -> bool:
        nonlocal poses
        bench.step()
        while host.poll(0):
            poses -= host.recv_multipart()[0] == SENSOR_POSE
        return poses <= 0

    until(heard)


def settled(bench: Bench) -> None:
    """Have the robot take what its listeners have said."""
    assert bench.poses.socket.poll(PATIENCE_MS)
    sent = bench.rig.ledger.poses_sent
    until(lambda: bench.step() or bench.rig.ledger.poses_sent > sent)


def looks_for_all(stays: zmq.Socket[Any], _: zmq.Socket[Any], bench: Bench) -> None:
    """As a daemon does that has looked for other topics."""
    stays.setsockopt(zmq.SUBSCRIBE, b"")
    settled(bench)
    stays.setsockopt(zmq.UNSUBSCRIBE, b"")


@pytest.mark.parametrize(
    "leave",
    [
        looks_for_all,
        lambda _, other, __: other.setsockopt(zmq.UNSUBSCRIBE, b"/robot"),
        lambda _, other, __: other.close(),
    ],
    ids=["all topics", "its own topic", "altogether"],
)
def test_poses_go_on_when_one_of_two_listeners_leaves(
    bench: Bench, sockets: Sockets, poses: str, leave: Callable[..., None]
) -> None:
    stays, other = sockets.subscriber(poses, SENSOR_POSE), sockets.subscriber(poses, b"/robot")
    hears(bench, stays)
    hears(bench, other)
    leave(stays, other, bench)
    settled(bench)
    hears(bench, stays)


def test_a_listener_that_connects_anew_goes_on_hearing(
    bench: Bench, sockets: Sockets, poses: str
) -> None:
    old = sockets.subscriber(poses, SENSOR_POSE, b"")
    hears(bench, old)
    old.close()
    settled(bench)
    hears(bench, sockets.subscriber(poses, SENSOR_POSE))


def test_poses_count_as_heard_only_while_somebody_listens_to_them(
    bench: Bench, sockets: Sockets, poses: str
) -> None:
    ledger = bench.rig.ledger
    host = sockets.subscriber(poses, b"/robot/other")
    settled(bench)
    assert ledger.poses_heard == 0
    host.setsockopt(zmq.SUBSCRIBE, SENSOR_POSE)
    hears(bench, host)
    host.setsockopt(zmq.UNSUBSCRIBE, SENSOR_POSE)
    settled(bench)
    heard, sent = ledger.poses_heard, ledger.poses_sent
    until(lambda: bench.step() or ledger.poses_sent > sent + 1)
    assert 3 <= heard == ledger.poses_heard


def test_arrays_come_from_the_first_listener_on_until_the_last_has_left(
    sockets: Sockets, tmp_path: Path
) -> None:
    rig, port = Rig(scenario.load("array"), 0), ArrayPort(tmp_path / "skin")
    frame, endpoint = ArrayFrame(5.0, "skin", 0, (10_000, 0, 10_002)), f"ipc://{tmp_path}/skin"

    def requests() -> int:
        assert port.feed.socket.poll(PATIENCE_MS)
        asked = port.take(0.0)
        for packet in asked:
            rig.answer(packet, 0.0)
        return len(asked)

    host = sockets.subscriber(endpoint)
    assert requests() == 1
    assert rig.hub.auto_sync, "the skin is started"
    assert port.send(frame)
    assert array.parse(array.read_json(host.recv())) == frame
    other = sockets.subscriber(endpoint, b"/skin")
    assert requests() == 0
    other.close()
    assert requests() == 0
    assert port.is_open
    host.close()
    assert requests() == 1
    assert not port.is_open
    assert not rig.hub.auto_sync
    port.close()


def test_the_link_that_a_killed_emulator_left_is_replaced_and_a_living_ones_left_alone(
    tmp_path: Path,
) -> None:
    def open_files() -> int:
        return len(list(Path("/proc/self/fd").iterdir()))

    link = tmp_path / "skin"
    link.symlink_to("/dev/pts/999999")
    port = NativePort(link)
    assert link.is_char_device()
    before, opened = link.readlink(), open_files()
    with pytest.raises(SetupError, match=r"skin: cannot be made \(another skin is there; stop it"):
        NativePort(link)
    assert link.readlink() == before
    assert open_files() == opened, "no pseudo-terminal is left open"
    port.close()
    assert not link.is_symlink()


@pytest.mark.parametrize(("name", "why"), [("no/skin", "No such file"), ("file", "File exists")])
def test_a_link_that_cannot_be_made_is_one_line(tmp_path: Path, name: str, why: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(SetupError, match=rf"{name}: cannot be made \({why}"):
        NativePort(tmp_path / name)
