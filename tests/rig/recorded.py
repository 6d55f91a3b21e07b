"""An idle skin that is then touched: as a recorded session, or live."""

import subprocess
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self

import msgpack
import numpy as np

from taxeld.stream import client
from taxeld_hil.rig.virtual_ihb import VirtualIhb
from taxeld_protocol.frames import parse_log_line
from tests.rig import sessions
from tests.rig.clocks import until
from tests.rig.configurations import QUIET, Table, configuration
from tests.rig.skins import CHANNELS, MODULES
from tests.rig.sockets import Sockets
from tests.rig.virtual_hub import VirtualHub, frames_of, told

from ..firmware_protocol.test_cyskin import GOLDEN_SCAN

PERIOD_S = 0.05
IDLE_SCANS = 25  # the baseline takes 20
IDLE_COUNTS, NOISE = 1000, 30.0
PRESSED = range(36, 44)  # channels of one side of the skin
DEAD = 5  # a channel that never reads anything


def scans(touches: int, rest: int = 0) -> Iterator[list[int]]:
    """The counts of each scan: idle, then `touches` times ten of touch and ten of none, and `rest`
    more of none."""
    rng = np.random.default_rng(0)
    for scan in range(-IDLE_SCANS, 20 * touches + rest):
        counts = IDLE_COUNTS + rng.normal(0.0, NOISE, CHANNELS)
        if 0 <= scan < 20 * touches and scan % 20 < 10:
            counts[PRESSED] += 8000.0
        counts[DEAD] = 0.0
        yield counts.astype(int).tolist()


def write_session(place: Path, touches: int = 1) -> None:
    """A session in `place`: the scans, after what the hub told of its modules."""
    ihb = VirtualIhb(MODULES)
    frames = frames_of(told(ihb), t=1e9)
    for number, counts in enumerate(scans(touches)):
        frames += frames_of(ihb.sensor_data(counts), t=1e9 + number * PERIOD_S)
    sessions.write(place, frames)


class LiveSkin(threading.Thread):
    """The same scans from a hub behind an adapter in `place`, the last of them again and again."""

    def __init__(self, place: Path, touches: int = 1, period_s: float = PERIOD_S, rest: int = 0):
        super().__init__(daemon=True)
        self._scans = list(scans(touches, rest))
        self._hub = VirtualHub(place / "skin", MODULES)
        self._stops = threading.Event()
        self.source = {**self._hub.source, "period_ms": round(1000 * period_s)}

    @property
    def has_ended(self) -> bool:
        return self._hub.scans >= len(self._scans)

    def run(self) -> None:
        with self._hub:
            while not self._stops.wait(0.002):
                self._hub.serve(
                    time.monotonic(), lambda k: self._scans[min(k, len(self._scans) - 1)]
                )

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stops.set()
        self.join()


Said = dict[str, list[dict[str, Any]]]


def said_of(
    place: Path, command: list[str], asks: dict[str, str], done: Callable[[Said], object]
) -> tuple[Said, str]:
    """All that a daemon which serves in `place` sends, by topic, until `done`, its answers, by the
    name of what is asked once a message of a topic has come, and what it prints."""
    said: Said = defaultdict(list)
    with Sockets() as sockets:
        socket = sockets.subscriber(f"ipc://{place}/stream")
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as daemon:

            def heard() -> object:
                assert daemon.poll() is None
                if socket.poll(20):
                    topic, body, stamp = socket.recv_multipart()
                    assert stamp.decode().partition(".")[2].isdigit()
                    said[topic.decode()].append(msgpack.unpackb(body))
                for name, after in asks.items():
                    if said[after] and not said[name]:
                        answer = client.ask(f"ipc://{place}/control", name, timeout_s=20.0)
                        assert answer is not None
                        said[name] = [answer]
                return done(said)

            try:
                until(heard)
                daemon.terminate()
                printed, _ = daemon.communicate()
            finally:
                daemon.kill()
        assert daemon.returncode == 0
    return {name: messages for name, messages in said.items() if messages}, printed


def write_golden(place: Path) -> None:
    """A session in `place`: the documented scan of one module, which does not tell its name."""
    frames = [parse_log_line(f"(1.000000) can0 {line}") for line in GOLDEN_SCAN]
    sessions.write(place, filter(None, frames))


def golden(place: Path, **tables: Table) -> Path:
    """The configuration beside `write_golden` of a daemon that serves nobody; `tables`: more
    keys."""
    whole: dict[str, Table] = {
        "source": QUIET | {"modules": [[1, 0xFFF]]},
        "publish": {"endpoints": []},
        "control": {"endpoint": ""},
    }
    more = {name: {**whole.get(name, {}), **keys} for name, keys in tables.items()}
    return configuration(place, **whole | more)
