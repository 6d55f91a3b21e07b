"""A rig in real time: its hub on a port, its robot on a socket, and a recording of both."""

import math
import time
from collections.abc import Callable
from pathlib import Path

import msgpack

from taxeld.errors import SetupError
from taxeld.source.session import Item, Pass, SensorPose
from taxeld.stream import topics
from taxeld_hil.rig.ledger import WireUnit
from taxeld_hil.rig.ports import ArrayPort, CanPort, Feed, NativePort, Port, SlcanPort
from taxeld_hil.rig.rig import BEFORE_S, Rig


class Bench:
    """Sends what the rig sends, in real time; to be stepped some hundred times a second."""

    def __init__(
        self,
        rig: Rig,
        where: Path | str,
        poses: str,
        record: Callable[[Item], None] = lambda _: None,
    ) -> None:
        """`where`: the name that a pseudo-terminal gets, or a CAN interface; `poses`: the robot's
        endpoint; `record` is called with all that passes.

        Raises:
            SetupError: there is no such interface, or a name or the endpoint is taken.
        """
        self.rig, self._record = rig, record
        rig.ledger.period_s = math.inf  # when the host reads is not known here
        self.start_s: float | None = None  # monotonic, of the first scan
        self._finished = False
        self.poses = Feed(poses, "--poses")
        try:
            self.port = self._opened(where)
        except SetupError:
            self.poses.close()
            raise

    def _opened(self, where: Path | str) -> Port:
        if isinstance(where, str):
            return CanPort(where, self._record)
        if self.rig.is_array:
            return ArrayPort(where)
        return NativePort(where) if self.rig.line else SlcanPort(where, self._record)

    @property
    def t(self) -> float:
        """Scenario time."""
        return BEFORE_S if self.start_s is None else time.monotonic() - self.start_s

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
        if not self._finished:
            for packet in requests:
                self._send(rig.answer(packet, self.t), wall)
            if self.start_s is None and rig.hub.auto_sync:
                self.start_s = time.monotonic()
            self._send(rig.scan(self.t, time.monotonic()), wall)
            for row in rig.poses(self.t, time.monotonic(), wall):
                self._publish(row)
        port.flush()

    def finish(self) -> None:
        """Send what was held back; nothing more is sent after it."""
        self._send(self.rig.rest(), time.time())
        self._finished = True

    def close(self) -> None:
        self.port.close()
        self.poses.close()

    def _send(self, units: list[WireUnit], wall: float) -> None:
        ledger = self.rig.ledger
        for unit in units:
            item = unit.at(wall)
            self._record(item)
            if not self.port.is_open:
                continue
            if self.port.send(item):
                ledger.deliver(unit, time.monotonic())
            else:
                ledger.refused += 1
        if units:
            self._record(Pass(wall))

    def _publish(self, row: tuple[float, float, float, float]) -> None:
        wall, x, y, theta = row
        # a pose that nobody hears is not sent: who begins to listen now would hear it uncounted
        if self.poses.is_heard(topics.SENSOR_POSE):
            body = msgpack.packb({"t": wall, "x": x, "y": y, "theta": theta})
            self.poses.send(topics.SENSOR_POSE, body, b"%.6f" % wall)
            self.rig.ledger.poses_heard += 1
        self._record(SensorPose(*row))
