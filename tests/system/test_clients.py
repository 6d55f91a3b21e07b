"""The examples: clients in each language use the same estimates, adapters send arrays."""

import contextlib
import json
import os
import runpy
import shutil
import socket
import subprocess
import sys
import threading
import time
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

import msgpack
import numpy as np
import pytest
import zmq

from taxeld.estimator.estimate import Status
from taxeld.layout import read as layouts
from taxeld.pipeline.freshness import Why
from taxeld.stream import topics
from taxeld_protocol import array
from taxeld_protocol.array import FULL, REST, ArrayFrame
from tests.ros2.loopback import DOMAIN, ENVIRONMENT

from ..rig.clocks import PATIENCE_S, until
from ..rig.sockets import Sockets
from ..rig.stream_page import documented

ROOT = Path(__file__).parents[2]
CLIENTS = ROOT / "examples" / "clients"
TOUCHES = [  # x of the pose, why it is not valid, and its status
    (0.1, Why.VALID, Status.CONVERGED),
    (0.2, Why.VALID, Status.AMBIGUOUS),
    (0.3, Why.VALID, Status.SEARCHING),
    (0.4, Why.OUTSIDE, Status.CONVERGED),
    (0.5, Why.INCONSISTENT, Status.INCONSISTENT),
    (0.6, Why.VALID, Status.CONVERGED),
]
LAYOUT = ROOT / "examples" / "plotjuggler.xml"
NODE_MODULES = Path(os.environ.get("NODE_PATH", str(Path(sys.prefix) / "node" / "node_modules")))
CPP_HEADERS = ("zmq_addon.hpp", "msgpack.hpp")


def said_of(x_m: float) -> str:
    """A client's line on the documented estimate at that x."""
    return f"x {x_m:.3f} m  y -0.021 m  yaw 0.52  p 0.996  003_cracker_box"


def python(_: Path) -> list[str] | None:
    return [sys.executable, "-u", str(CLIENTS / "subscribe.py")]


def cpp(place: Path) -> list[str] | None:
    compiler, built = shutil.which("g++"), str(place / "subscribe")
    if compiler is None or not all(Path("/usr/include", name).exists() for name in CPP_HEADERS):
        return None
    how = ("-std=c++17", "-Wall", "-Wextra", "-Werror")
    command = [compiler, *how, CLIENTS / "subscribe.cpp", "-o", built, "-lzmq"]
    subprocess.run(command, check=True)
    return [built]


def node(place: Path) -> list[str] | None:
    program = shutil.which("node")
    if program is None or not (NODE_MODULES / "zeromq").is_dir():
        return None
    shutil.copy(CLIENTS / "subscribe.mjs", place)
    (place / "node_modules").symlink_to(NODE_MODULES)
    return [program, str(place / "subscribe.mjs")]


MAKERS = {"python": python, "cpp": cpp, "node": node}  # None without the language's tools
NEEDS = f"g++, cppzmq-dev and libmsgpack-cxx-dev, or node and in {NODE_MODULES} its packages"


def started(place: Path, name: str, command: list[str]) -> "subprocess.Popen[bytes]":
    """A client of the daemon in `place`; what it prints goes into a file of its name."""
    with (place / name).open("wb") as printed:
        return subprocess.Popen([*command, f"ipc://{place}/stream"], stdout=printed)


@pytest.fixture(scope="module")
def printed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    """What each client has printed after the same touches."""
    place = tmp_path_factory.mktemp("run")
    commands = {name: made for name, make in MAKERS.items() if (made := make(place)) is not None}
    clients = [started(place, name, command) for name, command in commands.items()]
    said = dict[str, list[str]]()

    def all_have_printed() -> bool:
        said.update((name, (place / name).read_text().splitlines()) for name in commands)
        return all(told[-1:] == [said_of(TOUCHES[-1][0])] for told in said.values())

    try:
        with Sockets() as sockets:
            daemon = sockets.open(zmq.XPUB)
            daemon.setsockopt(zmq.XPUB_VERBOSE, 1)
            daemon.bind(f"ipc://{place}/stream")
            for _ in clients:
                assert daemon.poll(1000 * PATIENCE_S), "a client has not subscribed"
                assert daemon.recv() == b"\x01" + topics.ESTIMATE
            for x_m, why, status in TOUCHES:
                for contact in (True, True, False, False):
                    estimate = documented("/taxeld/estimate")[1]
                    estimate |= {"valid": why is Why.VALID, "why": why, "status": status}
                    estimate |= {"contact": contact, "map": {**estimate["map"], "x": x_m}}
                    body = msgpack.packb(estimate)
                    daemon.send_multipart([topics.ESTIMATE, body, b"1700000005.121000"])
            until(all_have_printed)
    finally:
        for client in clients:
            client.kill()
            client.wait()
    return said


@pytest.mark.parametrize("name", list(MAKERS))
def test_each_client_prints_the_pose_after_a_touch_if_it_is_valid_and_converged(
    name: str, printed: dict[str, list[str]]
) -> None:
    if name not in printed:
        pytest.skip(f"{NEEDS}: not here")
    assert printed[name] == [said_of(0.1), said_of(0.6)]


def test_a_wrong_argument_of_the_python_client_is_told_without_a_traceback() -> None:
    command = [sys.executable, CLIENTS / "subscribe.py", "nonsense"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr.count("\n")) == (1, 1)
    assert ended.stderr.startswith("nonsense: ")


@pytest.mark.parametrize("name", MAKERS)
def test_a_client_that_starts_first_hears_a_daemon_that_comes_later(
    tmp_path: Path, name: str
) -> None:
    command = MAKERS[name](tmp_path)
    if command is None:
        pytest.skip(f"{NEEDS}: not here")
    environ = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path)}
    own = f"ipc://{tmp_path}/taxeld/stream"
    with (
        subprocess.Popen(
            command, env=environ, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        ) as client,
        Sockets() as sockets,
    ):
        try:
            lines = [client.stderr.readline().decode() for _ in range(2)]
            assert lines == [f"listening at {at}\n" for at in ("ipc:///run/taxeld/stream", own)]
            (tmp_path / "taxeld").mkdir()
            daemon = sockets.open(zmq.XPUB)
            daemon.bind(own)
            assert daemon.poll(1000 * PATIENCE_S), "it has not subscribed"
        finally:
            client.kill()


def test_plotjugglers_layout_plots_keys_that_are_sent_and_fills_each_of_its_panes() -> None:
    layout = ET.parse(LAYOUT).getroot()  # noqa: S314
    sent = set()
    for topic in ("/taxeld/estimate", "/taxeld/health"):
        _, example = documented(topic)
        sent |= set(_series(topic, example))
    plotted = set()
    for curve in layout.iter("curve"):
        if curve.get("curve_x"):
            plotted |= {curve.get("curve_x"), curve.get("curve_y")}
        else:
            plotted.add(curve.get("name"))
    assert len(plotted) > 20
    assert plotted <= sent
    assert all(len(one) == int(one.get("count", "")) for one in layout.iter("DockSplitter"))


def _series(name: str, value: object) -> Iterator[str]:
    """The names that PlotJuggler gives to the numbers of a map."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _series(f"{name}/{key}", item)
    elif isinstance(value, list):
        for k, item in enumerate(value):
            yield from _series(f"{name}[{k}]", item)
    else:
        yield name


ADAPTERS = ROOT / "examples" / "adapters"
FOREARM = ROOT.parent / "shared" / "data" / "icub_positions" / "left_forearm_V2.txt"


class Ear:
    """A subscriber, as the door's."""

    def __init__(self, sockets: Sockets, endpoint: str) -> None:
        self.endpoint, self.socket = endpoint, sockets.subscriber(endpoint)

    def frame(self) -> ArrayFrame:
        """The next array, which the door would pass on."""
        until(lambda: self.socket.poll(20))
        return array.parse(array.read_json(self.socket.recv()))  # type: ignore[return-value]


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
