"""A virtual hub behind one of the harness's pseudo-terminals, served by the test itself."""

import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Self

from taxeld_hil.rig.ports import NativePort, SlcanPort
from taxeld_hil.rig.virtual_ihb import Answer, Phase, VirtualIhb
from taxeld_protocol import cyskin, serial_link, slcan
from taxeld_protocol.cyskin import (
    ALL_MODULES,
    BROADCAST,
    LEAVE_BOOTLOADER,
    Command,
    ErrorCode,
    Packet,
)
from taxeld_protocol.frames import Chunk, Frame
from taxeld_protocol.modules import Module
from tests.rig.adapters import KINDS

Counts = Sequence[int | None]


def told(hub: VirtualIhb) -> list[Answer]:
    """What a hub whose modules run answers to DECLARE and MODULE_DETAILS."""
    hub.phase = Phase.RUNNING
    asked = [(Command.DECLARE, b""), (Command.MODULE_DETAILS, bytes((ALL_MODULES,)))]
    return [a for request in asked for a in hub.answer(Packet(0.0, BROADCAST, *request))]


def frames_of(answers: Iterable[Answer], ihb: int = 1, t: float = 0.0) -> list[Frame]:
    """Answers of a hub as they go over CAN."""
    return [frame for answer in answers for frame in cyskin.to_frames(*answer, ihb=ihb, t=t)]


class LateHub(VirtualIhb):
    """By the times of the requests its modules start late, and it drops requests, or says that it
    is busy, after it was told to be silent."""

    def __init__(
        self, modules: Sequence[Module], uid: int = 0xC15C0001, short_id: int = 1, **late: float
    ) -> None:
        """`late`: `modules_s` and `deaf_s`, and whether it `says_busy`."""
        self._late = {"modules_s": 0.0, "deaf_s": 0.0, "says_busy": False} | late
        super().__init__(modules, uid, short_id)

    def reboot(self) -> None:
        super().reboot()
        self._runs_s, self._hears_s = math.inf, -math.inf

    def answer(self, packet: Packet) -> list[Answer]:
        if packet.t >= self._runs_s:
            self.phase, self._runs_s = Phase.RUNNING, math.inf
        is_mine = packet.ihb in (self.short_id, BROADCAST)
        if is_mine and packet.command != Command.ERROR and packet.t < self._hears_s:
            if not self._late["says_busy"] or packet.command == LEAVE_BOOTLOADER:
                return []
            return [(Command.ERROR, bytes((packet.command, ErrorCode.BUSY)))]
        was, answers = self.phase, super().answer(packet)
        if was < self.phase == Phase.RUNNING and self._late["modules_s"]:
            self.phase = was
            self._runs_s = min(self._runs_s, packet.t + self._late["modules_s"])
        if is_mine and packet.command == Command.SET_AUTO_SYNC and not self.auto_sync:
            self._hears_s = packet.t + self._late["deaf_s"]
        return answers


class StuckHub(VirtualIhb):
    """It does not leave its bootloader."""

    def answer(self, packet: Packet) -> list[Answer]:
        starts = packet.command == Command.MODULE_PROGRAM_END
        return [] if starts else super().answer(packet)


class VirtualHub:
    """A hub on SLCAN, or on the native link, behind a device name that outlives its terminals."""

    def __init__(
        self,
        link: Path,
        modules: Sequence[Module],
        *,
        native: bool = False,
        short_id: int = 1,
        adapter: str = "plain",
    ) -> None:
        phase = Phase.MODULES if native else Phase.BOOTLOADER  # that link is the application's
        self.ihb = VirtualIhb(modules, short_id=short_id, phase=phase)
        self.requests: list[Frame] = []  # of the host, on the bus behind an SLCAN adapter
        self.port = (
            NativePort(link) if native else SlcanPort(link, self.requests.append, KINDS[adapter])
        )
        self.native = native
        self.device = str(link)
        self.scans = 0  # that were sent,
        self.written = 0  # and bytes

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.unplug()

    @property
    def source(self) -> dict[str, str]:
        """The table of a configuration of a daemon on this hub."""
        kind = {"kind": "serial"} if self.native else {"kind": "can", "interface": "slcan"}
        return kind | {"channel": self.device}

    def unplug(self) -> None:
        """Take the device away at once, and its power."""
        self.port.close()
        self.ihb.reboot()

    def plug(self) -> None:
        self.port.set_plugged(True)

    def serve(self, now: float, counts: Callable[[int], Counts]) -> None:
        """Answer the host; where a scan is due, send the counts of that number."""
        self.answer(now)
        if self.ihb.due(now):
            self.scan(counts(self.scans))

    def answer(self, t: float) -> None:
        """Take the host's requests and answer them."""
        for packet in self.port.take(t):
            self.send(self.ihb.answer(packet))
        self.port.flush()

    def scan(self, counts: Counts) -> None:
        """Send one scan, whether it is due or not."""
        self.scans += 1
        self.send(self.ihb.sensor_data(counts))

    def send(self, answers: Iterable[Answer]) -> None:
        for command, payload in answers:
            for item in self.items(command, payload):
                if self.port.is_open and self.port.send(item):
                    is_line = isinstance(item, Chunk)
                    self.written += len(item.data if is_line else slcan.encode(item))

    def items(self, command: int, payload: bytes) -> Sequence[Frame | Chunk]:
        """A packet as it goes over the wire."""
        if self.native:
            return [Chunk(0.0, serial_link.encode(command, payload, ihb=self.ihb.short_id))]
        return cyskin.to_frames(command, payload, ihb=self.ihb.short_id, t=0.0)
