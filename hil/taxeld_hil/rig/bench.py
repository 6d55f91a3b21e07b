"""A rig in real time: its hub on a port, its robot on a socket, and a recording of both."""

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack
import zmq

from taxeld.source.session import Item
from taxeld.stream import topics
from taxeld_hil.rig.ledger import WireUnit
from taxeld_hil.rig.ports import ArrayPort, CanPort, NativePort, Port, SlcanPort, is_heard
from taxeld_hil.rig.rig import BEFORE_S, Rig
from taxeld_hil.scenario.scenario import Scenario
from taxeld_protocol.frames import Chunk


class Bench:
    """Sends what the rig sends, in real time; to be stepped some hundred times a second."""

    def __init__(
        self,
        rig: Rig,
        where: Path | str,
        poses: zmq.Socket[Any],
        record: Callable[[Item], None] = lambda _: None,
    ) -> None:
        """`where`: the name that a pseudo-terminal gets, or a CAN interface; `poses`: an XPUB;
        `record` is called with all that passes.

        Raises:
            SetupError: there is no such interface, or the name is taken.
        """
        self.rig, self.record = rig, record
        rig.ledger.period_s = math.inf  # when the host reads is not known here
        self.start_s: float | None = None  # monotonic, of the first scan
        self._poses = poses
        self._prefixes = set[bytes]()
        self._finished = False
        self.port: Port
        if isinstance(where, str):
            self.port = CanPort(where, self._record)
        elif rig.is_array or rig.line:
            self.port = ArrayPort(where) if rig.is_array else NativePort(where)
        else:
            self.port = SlcanPort(where, self._record)

    def _record(self, item: Item) -> None:
        self.record(item)

    @property
    def t(self) -> float:
        """Scenario time."""
        return BEFORE_S if self.start_s is None else time.monotonic() - self.start_s

    def lap(self, scenario: Scenario, seed: int) -> None:
        """Go on with another scenario; the first lap begins when a host starts the skin."""
        self.rig.lap(scenario, seed)
        self._finished = False
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

    def close(self) -> None:
        self.port.close()

    def _send(self, units: list[WireUnit], wall: float) -> None:
        ledger = self.rig.ledger
        for unit in units:
            item = unit.item
            if isinstance(item, bytes):
                self.record(Chunk(wall, item))
            else:
                item = item._replace(t=wall)
                unit = unit._replace(item=item)  # noqa: PLW2901
                self.record(item)
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
        self.record((wall, x, y, theta))
