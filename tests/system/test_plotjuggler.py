"""The streams as PlotJuggler's own code reads them, where its sources are: `PLOTJUGGLER` names a
checkout. Built of it are the ZeroMQ subscriber and the MessagePack parser."""

import os
import subprocess
import threading
import time
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

import msgpack
import pytest
import zmq

from taxeld.stream import messages

from ..daemon.test_stream_document import documented
from .test_clients import LAYOUT

SOURCES = Path(os.environ.get("PLOTJUGGLER", "/nowhere"))
MAIN = Path(__file__).parent / "plotjuggler.cpp"
QT = Path("/usr/lib/qt5/bin")  # Debian's qtbase5-dev
ENOUGH, PATIENCE_S = 40, 120.0
SECOND_MODE = "/taxeld/estimate/modes[1]/"

pytestmark = pytest.mark.skipif(
    not (SOURCES / "plotjuggler_app").is_dir() or not (QT / "moc").exists(),
    reason="PLOTJUGGLER names no checkout, or qtbase5-dev is not installed",
)
Series = dict[str, tuple[int, float, float]]  # points; time and value of the last


@pytest.fixture(scope="module")
def listener(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("plotjuggler")
    streamer, base = SOURCES / "plotjuggler_plugins" / "DataStreamZMQ", SOURCES / "plotjuggler_base"
    headers = base / "include"
    seen = [f"-I{path}" for path in (place, streamer, headers, SOURCES / "plotjuggler_app")]
    seen.append(f"-I{headers / 'PlotJuggler'}")
    asked = ["pkg-config", "--cflags", "--libs", "Qt5Widgets", "Qt5Xml"]
    qt = subprocess.run(asked, check=True, capture_output=True, text=True).stdout.split()
    form = ("datastream_zmq.ui", "ui_datastream_zmq.h")
    subprocess.run([QT / "uic", streamer / form[0], "-o", place / form[1]], check=True)
    built = place / "listener"
    sources = [
        MAIN, streamer / "datastream_zmq.cpp", SOURCES / "plotjuggler_app" / "nlohmann_parsers.cpp",
        base / "src" / "plotdata.cpp", base / "src" / "datastreamer_base.cpp",
    ]  # fmt: skip
    includes = [flag for flag in qt if flag.startswith("-I")]
    for header in (
        streamer / "datastream_zmq.h", headers / "PlotJuggler" / "datastreamer_base.h"
    ):  # fmt: skip
        sources.append(place / f"moc_{header.stem}.cpp")
        subprocess.run([QT / "moc", *seen, *includes, header, "-o", sources[-1]], check=True)
    how = ["g++", "-std=c++17", "-w", "-fPIC", *seen, *sources, "-o", built, *qt, "-lzmq", "-lfmt"]
    subprocess.run(how, check=True)
    return built


class Speaker:
    """Publishes the documented messages over TCP, 20 times a second, until it is left."""

    def __init__(self, frames: int) -> None:
        self._frames = frames
        self._is_over = False
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.XPUB)
        self._socket.linger = 0
        self.port = self._socket.bind_to_random_port("tcp://127.0.0.1")
        self._thread = threading.Thread(target=self._speak)

    def __enter__(self) -> "Speaker":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_over = True
        self._thread.join()
        self._socket.close()
        self._context.term()

    def _speak(self) -> None:
        said = {topic: documented(topic.decode())[1] for topic in messages.TOPICS}
        for number in range(100_000):
            t = 1e9 + 0.05 * number
            for topic, body in said.items():
                sent = topic, msgpack.packb(body | ({"t": t} if "t" in body else {})), b"%.6f" % t
                self._socket.send_multipart(sent[: self._frames])
            if self._is_over:
                return
            time.sleep(0.05)


def heard(listener: Path, frames: int, place: Path, *arguments: str) -> Series:
    """What it has made of the messages once there are `ENOUGH` of each."""
    environ = os.environ | {"QT_QPA_PLATFORM": "offscreen"}
    with Speaker(frames) as speaker:
        command = [listener, str(speaker.port), place, *arguments]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environ) as process:
            try:
                assert process.stdout is not None
                return next(many for many in _printed(process.stdout) if _is_enough(many))
            finally:
                process.kill()


def _printed(lines: Iterator[str]) -> Iterator[Series]:
    end_s, found = time.monotonic() + PATIENCE_S, {}
    for line in lines:
        assert time.monotonic() < end_s, f"too little was heard: {sorted(found)[:5]}"
        if line.strip():
            name, points, t, value = line.split("\t")
            found[name] = int(points), float(t), float(value)
        else:
            yield found
            found = {}


def _is_enough(found: Series) -> bool:
    seen = [found.get(f"{topic.decode()}/v", (0, 0.0, 0.0))[0] for topic in messages.TOPICS]
    return min(seen) >= ENOUGH


def plotted() -> set[str]:
    curves = ET.parse(LAYOUT).getroot().iter("curve")  # noqa: S314
    named = [(c.get("curve_x"), c.get("curve_y")) if c.get("curve_x") else (c.get("name"),)
             for c in curves]  # fmt: skip
    return {name for pair in named for name in pair if name}


@pytest.mark.parametrize(("frames", "stamped"), [(3, ()), (2, ("t",))])
def test_plotjuggler_reads_each_message_whole_and_finds_what_the_layout_plots(
    listener: Path, tmp_path: Path, frames: int, stamped: tuple[str, ...]
) -> None:
    found = heard(listener, frames, tmp_path, *stamped)
    names = plotted()
    assert len(names) > 20
    assert {name for name in names if not name.startswith(SECOND_MODE)} <= found.keys()
    for topic in messages.TOPICS:
        _, body = documented(topic.decode())
        for name, value in _values(topic.decode(), body):
            if name.endswith("/t"):
                continue
            assert found[name][2] == pytest.approx(value, nan_ok=True), name
        if "t" in body or frames == 3:  # else that of its arrival
            assert 1e9 <= found[f"{topic.decode()}/v"][1] < 1e9 + 1e5, "that of the measurement"


def _values(name: str, value: object) -> Iterator[tuple[str, float]]:
    """The numbers of a map by the names of their series."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _values(f"{name}/{key}", item)
    elif isinstance(value, list):
        for k, item in enumerate(value):
            yield from _values(f"{name}[{k}]", item)
    elif isinstance(value, int | float):
        yield name, float(value)
