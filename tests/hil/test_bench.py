"""The emulated robot: its poses go on as long as anybody listens to them."""

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import zmq

from taxeld.stream.topics import SENSOR_POSE
from taxeld_hil.rig.bench import Bench
from taxeld_hil.rig.ports import ArrayPort
from taxeld_hil.rig.rig import Rig
from taxeld_hil.scenario import scenario
from tests.rig.clocks import PATIENCE_S, until
from tests.rig.sockets import Sockets

POSES = "inproc://poses"
PATIENCE_MS = int(1e3 * PATIENCE_S)


@pytest.fixture
def sockets() -> Iterator[Sockets]:
    with Sockets() as made:
        yield made


@pytest.fixture
def bench(sockets: Sockets, tmp_path: Path) -> Iterator[Bench]:
    poses = sockets.open(zmq.XPUB)
    poses.bind(POSES)
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
    sent = bench.rig.ledger.poses_sent
    until(lambda: bench.step() or bench.rig.ledger.poses_sent > sent + 1)


@pytest.mark.parametrize("leaves", ["all topics", "its own topic", "altogether"])
def test_poses_go_on_when_one_of_two_listeners_leaves(
    bench: Bench, sockets: Sockets, leaves: str
) -> None:
    stays, other = sockets.subscriber(POSES, SENSOR_POSE), sockets.subscriber(POSES, b"/robot")
    hears(bench, stays)
    hears(bench, other)
    if leaves == "altogether":
        other.close()
    elif leaves == "all topics":  # as a daemon does that has looked for other topics
        stays.setsockopt(zmq.SUBSCRIBE, b"")
        settled(bench)
        stays.setsockopt(zmq.UNSUBSCRIBE, b"")
    else:
        other.setsockopt(zmq.UNSUBSCRIBE, b"/robot")
    settled(bench)
    hears(bench, stays)


@pytest.mark.parametrize("leaves_first", [True, False])
def test_a_listener_that_connects_anew_goes_on_hearing(
    bench: Bench, sockets: Sockets, leaves_first: bool
) -> None:
    old = sockets.subscriber(POSES, SENSOR_POSE, b"")
    hears(bench, old)
    if leaves_first:
        old.close()
        settled(bench)
    new = sockets.subscriber(POSES, SENSOR_POSE)
    old.close()
    settled(bench)
    hears(bench, new)


def test_poses_count_as_heard_only_while_somebody_listens_to_them(
    bench: Bench, sockets: Sockets
) -> None:
    ledger = bench.rig.ledger
    host = sockets.subscriber(POSES, b"/robot/other")
    settled(bench)
    assert ledger.poses_heard == 0
    host.setsockopt(zmq.SUBSCRIBE, SENSOR_POSE)
    hears(bench, host)
    host.setsockopt(zmq.UNSUBSCRIBE, SENSOR_POSE)
    settled(bench)
    heard = ledger.poses_heard
    settled(bench)
    assert 3 <= heard == ledger.poses_heard


def test_arrays_go_on_when_one_of_two_listeners_leaves(sockets: Sockets, tmp_path: Path) -> None:
    port, endpoint = ArrayPort(tmp_path / "skin"), f"ipc://{tmp_path}/skin"
    listening = port._socket
    sockets.subscriber(endpoint)
    assert listening.poll(PATIENCE_MS)
    assert len(port.take(0.0)) == 1, "the skin is started"
    other = sockets.subscriber(endpoint, b"/skin")
    assert listening.poll(PATIENCE_MS)
    assert port.take(0.0) == []
    other.close()
    assert listening.poll(PATIENCE_MS)
    assert port.take(0.0) == []
    assert port.is_open
    port.close()
