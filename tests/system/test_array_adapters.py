"""The adapters in examples/adapters: each sends arrays of what it adapts, or of a stand-in."""

import contextlib
import json
import runpy
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from taxeld.layout import read as layouts
from taxeld_protocol import array
from taxeld_protocol.array import FULL, REST, ArrayFrame
from tests.rig.clocks import until
from tests.rig.sockets import Sockets
from tests.ros2.loopback import DOMAIN, ENVIRONMENT

ROOT = Path(__file__).parents[2]
ADAPTERS = ROOT / "examples" / "adapters"
FOREARM = ROOT.parent / "shared" / "data" / "icub_positions" / "left_forearm_V2.txt"


class Ear:
    """A subscriber, as the door's."""

    def __init__(self, sockets: Sockets, endpoint: str) -> None:
        self.endpoint, self.socket = endpoint, sockets.subscriber(endpoint)

    def frame(self) -> ArrayFrame:
        """The next array, which the door would pass on."""
        until(lambda: self.socket.poll(20))
        found = array.parse(array.read_json(self.socket.recv()))
        assert isinstance(found, ArrayFrame), found
        return found


@pytest.fixture
def ear(tmp_path: Path) -> Iterator[Ear]:
    with Sockets() as sockets:
        yield Ear(sockets, f"ipc://{tmp_path}/skin")


@contextlib.contextmanager
def running(name: str, *arguments: object) -> Iterator[None]:
    command = [sys.executable, str(ADAPTERS / f"{name}.py"), *map(str, arguments)]
    with subprocess.Popen(command, env=ENVIRONMENT) as process:
        try:
            yield
        finally:
            process.kill()


def test_xelas_server_gives_the_z_of_all_sensors_in_their_order(ear: Ear) -> None:
    """By a stand-in that speaks its public format over a real WebSocket."""
    server = pytest.importorskip("websockets.sync.server")
    closed = pytest.importorskip("websockets.exceptions").ConnectionClosed

    def sensor(number: int, t: float, first: int) -> dict[str, object]:
        values = [first + i for i in range(12)]  # x, y, z of four taxels
        words = ",".join(f"{value:04X}" for value in values)
        return {"sensor": str(number), "time": t, "model": "XR1944", "taxels": 4, "data": words}

    def handle(peer: object) -> None:
        hello = {"message": "Welcome", "version": "1.7"}
        whole = {"message": 7, "sensors": 2, "10": sensor(10, 2.0, 200), "2": sensor(2, 1.5, 100)}
        with contextlib.suppress(closed):
            while True:
                for each in (hello, whole):
                    peer.send(json.dumps(each))  # type: ignore[attr-defined]
                time.sleep(0.02)

    with server.serve(handle, "127.0.0.1", 0) as served:
        threading.Thread(target=served.serve_forever, daemon=True).start()
        with running("xela", f"ws://127.0.0.1:{served.socket.getsockname()[1]}", ear.endpoint):
            frame = ear.frame()
        served.shutdown()
    assert frame == ArrayFrame(1.5, "xela", 0, (102, 105, 108, 111, 202, 205, 208, 211))


def test_a_port_of_yarp_gives_the_layouts_taxels_out_of_twelve_a_triangle(
    ear: Ear, tmp_path: Path
) -> None:
    """By a stand-in that speaks the text protocol of YARP's own tutorial."""
    if not FOREARM.exists():
        pytest.skip("needs iCub's positions")
    table = runpy.run_path(str(ROOT / "examples" / "icub_positions.py"))["table"]
    layout = tmp_path / "forearm.csv"
    layout.write_text(table(FOREARM.read_text(encoding="utf-8")), encoding="ascii")
    skin = layouts.read(str(layout))
    size = 12 * (int(skin.uid.max() >> 4) + 1)
    values = [float(i % 250) for i in range(size)]

    def serve() -> None:
        with listening.accept()[0] as peer, peer.makefile("r", encoding="ascii") as said:
            assert said.readline().startswith("CONNECT ")
            peer.sendall(b"Welcome taxeld\n")
            assert said.readline() == "r\n"
            text = " ".join(map(str, values))
            said_by_yarp = f"do 2654 1215723086.182938\n{text}\ndo\n{text}\n".encode()
            with contextlib.suppress(OSError):
                while True:
                    peer.sendall(said_by_yarp)
                    time.sleep(0.02)

    with socket.create_server(("127.0.0.1", 0)) as listening:
        threading.Thread(target=serve, daemon=True).start()
        with running("yarp_skin", "127.0.0.1", listening.getsockname()[1], layout, ear.endpoint):
            frame, unstamped = sorted([ear.frame(), ear.frame()])
    expected = [values[12 * (uid >> 4) + (uid & 0xF)] / 255.0 for uid in skin.uid.tolist()]
    assert (frame.t, frame.id) == (1215723086.182938, "yarp")
    assert unstamped.counts == frame.counts
    np.testing.assert_allclose((np.array(frame.counts) - REST) / FULL, expected, atol=1e-4)


WRITER = """
import sys, time
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from ros2_array import CDR, Places, Values, DomainParticipant, Topic
from cyclonedds.pub import DataWriter
at = DomainParticipant(int(sys.argv[2]))
writer = DataWriter(at, Topic(at, "rt/skin", Values), qos=CDR)
while True:
    writer.write(Values(Places([], 0), [1.0, 2.25, 40000.0]))
    time.sleep(0.05)
"""


def test_a_topic_of_ros_2_comes_as_counts(ear: Ear) -> None:
    pytest.importorskip("cyclonedds")
    command = [sys.executable, "-c", WRITER, str(ADAPTERS), str(DOMAIN)]
    with (
        running("ros2_array", "skin", ear.endpoint, DOMAIN),
        subprocess.Popen(command, env=ENVIRONMENT) as writer,
    ):
        try:
            frame = ear.frame()
        finally:
            writer.kill()
    assert (frame.id, frame.counts) == ("skin", (1, 2, 40_000))
