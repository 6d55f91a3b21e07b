"""A virtual hub behind one of the harness's pseudo-terminals, served by the test itself."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Self

from taxeld_hil.rig.ports import NativePort, SlcanPort
from taxeld_protocol import cyskin, serial_link, slcan
from taxeld_protocol.cyskin import ALL_MODULES, BROADCAST, Command, Packet
from taxeld_protocol.frames import Chunk, Frame
from taxeld_protocol.modules import Module
from taxeld_protocol.virtual_ihb import Answer, Phase, VirtualIhb
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
