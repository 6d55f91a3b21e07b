"""The clients in examples/clients, each in its own language, use the same estimates."""

import os
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

import msgpack
import pytest
import zmq

from taxeld.estimator.estimate import Status
from taxeld.pipeline.freshness import Why
from taxeld.stream import topics

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
            assert client.stderr is not None
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
    for splitter in layout.iter("DockSplitter"):
        areas = len(splitter)
        assert splitter.get("count") == str(areas)
        assert len(splitter.get("sizes", "").split(";")) == areas
        assert all(area.find("plot") is not None for area in splitter)
    streamer = layout.find("previouslyLoaded_Streamer")
    assert streamer is not None
    assert streamer.get("name") == "ZMQ Subscriber"


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
