"""The skin's end of a transport: its device's name, and its listeners, who come and go."""

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
import zmq

from taxeld.errors import SetupError
from taxeld.stream.topics import SENSOR_POSE
from taxeld_hil.rig.bench import Bench
from taxeld_hil.rig.ports import ArrayPort, Feed, NativePort
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


def test_a_topic_is_heard_until_the_last_of_those_leaves_whose_prefixes_have_it(
    sockets: Sockets, tmp_path: Path
) -> None:
    endpoint = f"ipc://{tmp_path}/poses"
    with Feed(endpoint, "--poses") as feed:

        def is_heard() -> bool:
            assert feed.socket.poll(PATIENCE_MS), "nobody has come or left"
            return feed.is_heard(SENSOR_POSE)

        stays = sockets.subscriber(endpoint, SENSOR_POSE)
        assert is_heard()
        stays.setsockopt(zmq.SUBSCRIBE, b"")  # as a daemon does that has looked for other topics
        assert is_heard()
        stays.setsockopt(zmq.UNSUBSCRIBE, b"")
        assert is_heard()
        other = sockets.subscriber(endpoint, b"/robot")
        assert is_heard()
        other.setsockopt(zmq.UNSUBSCRIBE, b"/robot")
        assert is_heard()
        other.setsockopt(zmq.SUBSCRIBE, b"/robot")
        assert is_heard()
        other.close()
        assert is_heard()
        stays.close()
        assert not is_heard()
        sockets.subscriber(endpoint, SENSOR_POSE)
        assert is_heard(), "one that connects anew"


def test_poses_are_sent_and_counted_only_while_somebody_listens_to_them(
    sockets: Sockets, tmp_path: Path
) -> None:
    rig, endpoint = Rig(scenario.load("demo"), 0), f"ipc://{tmp_path}/poses"
    ledger, host = rig.ledger, sockets.subscriber(endpoint, b"/robot/other")
    with closing(Bench(rig, tmp_path / "skin", endpoint)) as bench:

        def sends() -> None:
            """Poses, after it has taken what the listener has said."""
            assert bench.poses.socket.poll(PATIENCE_MS)
            sent = ledger.poses_sent
            until(lambda: bench.step() or ledger.poses_sent > sent + 1)

        sends()
        assert ledger.poses_heard == 0
        host.setsockopt(zmq.SUBSCRIBE, SENSOR_POSE)
        sends()
        counted = ledger.poses_heard
        assert counted > 0
        for _ in range(counted):
            assert host.poll(PATIENCE_MS)
            assert host.recv_multipart()[0] == SENSOR_POSE
        host.setsockopt(zmq.UNSUBSCRIBE, SENSOR_POSE)
        sends()
        assert ledger.poses_heard == counted


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
