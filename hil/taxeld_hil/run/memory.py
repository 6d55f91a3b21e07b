"""The wire of a run on the fake clock: a rig at one end, a device of the daemon's at the other."""

from collections.abc import Callable, Sequence
from typing import Any

from taxeld.errors import SetupError
from taxeld.source.device import Device, LostError
from taxeld.source.session import Item
from taxeld_hil.rig.rig import Rig
from taxeld_protocol.cyskin import Packet
from taxeld_protocol.frames import Chunk, Frame


class MemoryLine:
    """The wire between rigs and the fake devices that are plugged into it, one after the other."""

    def __init__(self, rig: Rig, *further: Rig) -> None:
        """`further`: of links whose hubs are on the same bus."""
        self.rig = rig
        self._rigs = (rig, *further)
        self.t = 0.0  # scenario time [s], which begins anew with each lap
        self.now = 0.0  # the daemon's clock [s], which goes on over laps
        self.record: Callable[[Item], None] = lambda _: None  # called with each delivered
        self._waiting: list[Any] = []  # frames or arrays
        self._bytes = b""

    @property
    def is_plugged(self) -> bool:
        return not any(rig.fails("unplugged", self.t) for rig in self._rigs)

    def send_due(self) -> None:
        """Deliver what the hub sends by itself at this time."""
        for rig in self._rigs:
            self._deliver(rig, rig.scan(self.t, self.now))

    def send_rest(self) -> None:
        """Deliver what was held back, at the end."""
        for rig in self._rigs:
            self._deliver(rig, rig.rest())

    def ask(self, to: int, command: int, payload: bytes) -> None:
        """Deliver the answers to a request."""
        packet = Packet(self.now, to, command, payload)
        for rig in self._rigs:
            self._deliver(rig, rig.answer(packet, self.t))

    def take(self) -> Sequence[Any]:
        """Frames, bytes or arrays delivered since the last call."""
        frames, data = self._waiting, self._bytes
        self._waiting, self._bytes = [], b""
        if self.rig.line:
            return [Chunk(self.now, data)] if data else []
        return frames

    def _deliver(self, rig: Rig, units: list[Any]) -> None:
        rig.ledger.deliver_all(units, self.now)
        for unit in units:
            item = unit.item
            if isinstance(item, bytes):
                self._bytes += item
                self.record(Chunk(self.now, item))
            else:  # a frame that was late arrives now
                frame = item if item.t == self.now else item._replace(t=self.now)
                self._waiting.append(frame)
                self.record(frame)


class MemoryDevice(Device):
    """The daemon's end of the wire. It has no descriptor: nobody waits on a fake clock."""

    def __init__(self, line: MemoryLine) -> None:
        """Raises SetupError where it is not plugged in."""
        super().__init__()
        self._line = line
        if not line.is_plugged:
            raise SetupError("unplugged")
        line.take()  # as a serial port is flushed when it is opened

    def read(self) -> Sequence[Frame | Chunk]:
        if not self._line.is_plugged:
            raise LostError
        return self._line.take()

    def send(self, to: int, command: int, payload: bytes) -> None:
        self._line.ask(to, command, payload)

    def close(self, wait_s: float = 0.0) -> None:
        """Nothing is held open."""
