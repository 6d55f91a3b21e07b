"""A rig in real time: its hub on a port, its robot on a socket, and a recording of both."""

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgpack
import zmq

from taxeld.errors import SetupError
from taxeld.source import session
from taxeld.source.recorder import Recorder
from taxeld.stream import topics
from taxeld_hil.rig.ledger import WireUnit
from taxeld_hil.rig.ports import ArrayPort, CanPort, NativePort, Port, SlcanPort, is_heard
from taxeld_hil.rig.rig import BEFORE_S, Rig
from taxeld_hil.scenario.scenario import Scenario
from taxeld_protocol.frames import Chunk


class Bench:
    """Sends what the rig sends, in real time; to be stepped some hundred times a second."""

    def __init__(
        self, rig: Rig, where: Path | str, poses: zmq.Socket[Any], recorder: Recorder
    ) -> None:
        """`where`: the name that a pseudo-terminal gets, or a CAN interface; `poses`: an XPUB."""
        self.rig = rig
        rig.ledger.period_s = math.inf  # when the host reads is not known here
        self.start_s: float | None = None  # monotonic, of the first scan
        self._recorder = recorder
        self._poses = poses
        self._prefixes = set[bytes]()
        self._finished = False
        self.port = self._opened(where)

    def _opened(self, where: Path | str) -> Port:
        if isinstance(where, str):
            return CanPort(where, self._recorder.take)
        if self.rig.is_array:
            return ArrayPort(where)
        if self.rig.line:
            return NativePort(where)
        return SlcanPort(where, self._recorder.take)

    @property
    def t(self) -> float:
        """Scenario time."""
        return BEFORE_S if self.start_s is None else time.monotonic() - self.start_s

    def lap(self, scenario: Scenario, seed: int) -> None:
        """Go on with another scenario; the first lap begins when a host starts the skin."""
        self.rig.lap(scenario, seed)
        if self.start_s is not None:
            self.start_s = time.monotonic()

    @property
    def was_stopped(self) -> bool:
        """Whether the host has switched the skin off."""
        return self.start_s is not None and self.rig.is_on(self.t) and not self.rig.hub.auto_sync

    def step(self) -> None:
        """Everything that is due."""
        wall = time.time()
        rig, port = self.rig, self.port
        port.set_plugged(not rig.fails("unplugged", self.t))
        requests = port.take(wall)
        if rig.fails("adapter_closed", self.t):
            port.close_channel()
        if self._finished:
            port.flush()
            return
        for packet in requests:
            self._send(rig.answer(packet, self.t), wall)
        if self.start_s is None and rig.hub.auto_sync:
            self.start_s = time.monotonic()
        self._send(rig.scan(self.t, time.monotonic()), wall)
        port.flush()
        for row in rig.poses(self.t, time.monotonic(), wall):
            self._publish(row)

    def finish(self) -> None:
        """Send what was held back; nothing more is sent after it."""
        self._send(self.rig.rest(), time.time())
        self._finished = True

    def host_died(self) -> None:
        self.port.forget()

    def host_begins(self) -> None:
        """Another host will listen."""
        self.rig.ledger.begin()

    def close(self) -> None:
        self.port.close()

    def _send(self, units: list[WireUnit], wall: float) -> None:
        ledger = self.rig.ledger
        for unit in units:
            item = unit.item
            if isinstance(item, bytes):
                self._recorder.take(Chunk(wall, item))
            else:
                unit = unit._replace(item=item._replace(t=wall))  # noqa: PLW2901
                self._recorder.take(item._replace(t=wall))
            if not self.port.is_open:
                continue
            if self.port.send(unit):
                ledger.deliver(unit, time.monotonic())
            else:
                ledger.refused += 1

    def _publish(self, row: tuple[float, float, float, float]) -> None:
        wall, x, y, theta = row
        body = msgpack.packb({"t": wall, "x": x, "y": y, "theta": theta})
        # a pose that nobody hears is not sent: who begins to listen now would hear it uncounted
        if is_heard(self._poses, self._prefixes, topics.SENSOR_POSE):
            frames = (topics.SENSOR_POSE, body, b"%.6f" % wall)
            self._poses.send_multipart(frames, zmq.NOBLOCK)
            self.rig.ledger.poses_heard += 1
        self._recorder.pose(wall, x, y, theta)


@contextmanager
def recorded(
    rig: Rig, where: Path | str, poses: zmq.Socket[Any], directory: Path
) -> Iterator[Bench]:
    """A bench that leaves its session in `directory`.

    Raises:
        SetupError: there is no such interface, or the directory has a file of one.
    """
    with Recorder(directory, moves=True) as recorder:
        write_truth(directory, rig)
        bench = Bench(rig, where, poses, recorder)
        try:
            yield bench
        finally:
            bench.close()


def write_config(directory: Path, config: str) -> Path:
    """Begin the session in a directory with its configuration; → the file.

    Raises:
        SetupError: the directory has a configuration, which a run would overwrite.
    """
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / session.CONFIG
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(config)
    except FileExistsError:
        raise SetupError(f"--out: {path} is there already; name another directory") from None
    return path


def write_truth(directory: Path, rig: Rig) -> None:
    """Write truth.csv of a session; it is complete as soon as it exists."""
    row = ",".join(f"{v:.6f}" for v in (time.time(), *rig.world.truth))
    header = ",".join(session.POSE_COLUMNS)
    directory.mkdir(parents=True, exist_ok=True)  # a recorder makes it with its first record
    partial = directory / f"{session.TRUTH}.partial"
    partial.write_text(f"{header}\n{row}\n", encoding="ascii")
    partial.rename(directory / session.TRUTH)
