"""The clients in examples/clients, each in its own language, hear a running daemon alike."""

import itertools
import os
import shutil
import subprocess
import sys
import tomllib
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq

from taxeld.stream import messages

from ..rig.clocks import PATIENCE_S, until
from ..rig.configurations import configuration
from ..rig.processes import taxeld
from ..rig.sockets import Sockets
from ..rig.stream_page import documented

ROOT = Path(__file__).parents[2]
CLIENTS = ROOT / "examples" / "clients"
SESSION = ROOT / "tests" / "daemon" / "session"  # four contacts of a mug
LAYOUT = ROOT / "examples" / "plotjuggler.xml"
NODE_MODULES = Path(os.environ.get("NODE_PATH", str(Path(sys.prefix) / "node" / "node_modules")))
CPP_HEADERS = ("zmq_addon.hpp", "msgpack.hpp")


def expected(estimates: list[dict[str, Any]]) -> list[str]:
    """What a client prints of these estimates, that came one after the other."""
    said = []
    for before, now in itertools.pairwise(estimates):
        if before["contact"] and not now["contact"] and now["valid"]:
            at, share = now["map"], now["modes"][0]["weight"]
            said.append(
                f"x {at['x']:.3f} m  y {at['y']:.3f} m  yaw {at['theta']:.2f}  ({share:.0%})"
            )
    return said


def python(place: Path) -> list[str] | None:  # noqa: ARG001
    return [sys.executable, "-u", str(CLIENTS / "subscribe.py")]


def cpp(place: Path) -> list[str] | None:
    compiler = shutil.which("g++")
    if compiler is None or not all(_has_header(compiler, name) for name in CPP_HEADERS):
        return None
    source, built = CLIENTS / "subscribe.cpp", place / "subscribe"
    how = ("-std=c++17", "-Wall", "-Wextra", "-Werror")
    subprocess.run([compiler, *how, source, "-o", built, "-lzmq"], check=True)
    return [str(built)]


def _has_header(compiler: str, name: str) -> bool:
    asked = f"#if !__has_include(<{name}>)\n#error\n#endif\n".encode()
    command = [compiler, "-E", "-x", "c++", "-"]
    return subprocess.run(command, input=asked, capture_output=True, check=False).returncode == 0


def node(place: Path) -> list[str] | None:
    program = shutil.which("node")
    if program is None or not (NODE_MODULES / "zeromq").is_dir():
        return None
    shutil.copy(CLIENTS / "subscribe.mjs", place)
    (place / "node_modules").symlink_to(NODE_MODULES)
    return [program, str(place / "subscribe.mjs")]


MAKERS = {"python": python, "cpp": cpp, "node": node}  # None without the language's tools
NEEDS = {
    "python": "python",
    "cpp": "g++, cppzmq-dev and libmsgpack-cxx-dev",
    "node": f"node, and in {NODE_MODULES} the packages of examples/clients",
}


def started(place: Path, name: str, command: list[str]) -> "subprocess.Popen[bytes]":
    """A client of the daemon in `place`; what it prints goes into a file of its name."""
    with (place / name).open("wb") as printed:
        return subprocess.Popen([*command, f"ipc://{place}/stream"], stdout=printed)


def configured(place: Path) -> Path:
    """A daemon that replays a recorded session and serves in `place`."""
    shutil.copytree(SESSION, place / "session")
    recorded = tomllib.loads((SESSION / "config.toml").read_text(encoding="utf-8"))
    source = {"kind": "replay", "path": place / "session"}
    return configuration(place, **{**recorded, "source": source})


def wait_for_subscriptions(sockets: Sockets, place: Path, wanted: int) -> None:
    """Until so many clients have started and subscribed; they will find the daemon by
    themselves, in the same place."""
    with sockets.open(zmq.XPUB) as stand_in:
        stand_in.setsockopt(zmq.XPUB_VERBOSE, 1)
        stand_in.bind(f"ipc://{place}/stream")
        for _ in range(wanted):
            assert stand_in.poll(1000 * PATIENCE_S), "a client has not subscribed"
            assert stand_in.recv() == b"\x01" + messages.ESTIMATE
    (place / "stream").unlink(missing_ok=True)


@pytest.fixture(scope="module")
def printed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    """What each client has printed of one run of a daemon, and what it should have."""
    place = tmp_path_factory.mktemp("run")
    config = configured(place)
    commands = {name: made for name, make in MAKERS.items() if (made := make(place)) is not None}
    clients = [started(place, name, command) for name, command in commands.items()]
    estimates: list[dict[str, Any]] = []
    try:
        with Sockets() as sockets:
            wait_for_subscriptions(sockets, place, len(clients))
            socket = sockets.subscriber(f"ipc://{place}/stream", messages.ESTIMATE)
            with taxeld("run", config) as daemon:
                while daemon.poll() is None or socket.poll(100):
                    if socket.poll(100):
                        estimates.append(msgpack.unpackb(socket.recv_multipart()[1]))
            assert daemon.returncode == 0
        lines, said = expected(estimates), dict[str, list[str]]()

        def all_have_printed() -> bool:
            said.update((name, (place / name).read_text().splitlines()) for name in commands)
            return all(len(told) >= len(lines) for told in said.values())

        until(all_have_printed)
    finally:
        for client in clients:
            client.kill()
            client.wait()
    return {**said, "expected": lines}


@pytest.mark.parametrize("name", list(MAKERS))
def test_each_client_prints_where_a_running_daemon_believes_the_object_after_each_touch(
    name: str, printed: dict[str, list[str]]
) -> None:
    if name not in printed:
        pytest.skip(f"{NEEDS[name]}: not here")
    assert len(printed["expected"]) >= 3
    assert printed[name] == printed["expected"]


def test_plotjugglers_layout_plots_keys_that_are_sent_and_fills_each_of_its_panes() -> None:
    layout = ET.parse(LAYOUT).getroot()  # noqa: S314
    sent = set()
    for topic in ("/taxeld/estimate", "/taxeld/health"):
        _, example = documented(topic)
        sent |= set(_series(topic, example))
    sent.add("/taxeld/estimate/modes[1]/weight")  # while there are two
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
