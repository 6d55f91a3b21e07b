"""A virtual hub: answers requests as a CySkin IHB does and turns counts into SENSOR_DATA.

It begins as a hub that was just powered. Its own bootloader is left by LEAVE_BOOTLOADER, and then
that of its modules by MODULE_PROGRAM_END. Until their application runs it declares no channels, and
sends no scan. Of the commands it does those that a bring-up needs, a cut of taxels and a reboot.
"""

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from enum import IntEnum
from types import MappingProxyType

from taxeld_protocol import commands, cyskin
from taxeld_protocol.cyskin import (
    ALL_MODULES,
    BROADCAST,
    LEAVE_BOOTLOADER,
    MAX_VALUES,
    Command,
    ErrorCode,
    Packet,
    Reassembler,
)
from taxeld_protocol.frames import Frame
from taxeld_protocol.modules import ALL_NAMES, NAMES, Module

DEFAULT_PERIOD_MS = 50
BRIEF_S = 1e-6  # sums of periods are not exact
VERSIONS: Mapping[int, str] = MappingProxyType(
    {
        Command.VERSION: "virtual 1",
        Command.MODULE_BTLDR_VERSION: "virtual 2",
        Command.MODULE_APP_VERSION: "virtual 3",
    }
)

Answer = tuple[int, bytes]  # command, payload


class Phase(IntEnum):
    """How far a hub is after power-on."""

    BOOTLOADER = 0  # its own
    MODULES = 1  # its application runs, its modules are in their bootloader
    RUNNING = 2


OBEYED = frozenset(
    {
        Command.DISCOVERY_PING,
        Command.DISCOVERY_RECV_ID,
        Command.MODULE_PROGRAM_END,
        Command.IHB_COLD_REBOOT,
        Command.SET_AUTO_SYNC,
        Command.SET_AUTO_SYNC_PERIOD,
        Command.DECLARE,
        Command.MODULE_DETAILS,
        Command.MODULE_SET_CUT_SENSORS,
    }
)
# Commands of those that need running modules; to be told to be silent needs none.
LATE = frozenset(
    {Command.SET_AUTO_SYNC, Command.SET_AUTO_SYNC_PERIOD, Command.MODULE_SET_CUT_SENSORS}
)


class HubLink(Reassembler):
    """A hub's end of the bus: the frame that ends its bootloader is a request like others."""

    def feed(self, frame: Frame) -> Packet | None:
        if frame.extended and frame[1:3] == (cyskin.BOOTLOADER_ID, cyskin.BOOTLOADER_EXIT):
            return Packet(frame.t, BROADCAST, LEAVE_BOOTLOADER, b"")
        return super().feed(frame)


class VirtualIhb:
    """One hub with its modules; no clock and no transport: its owner asks `due` and sends."""

    def __init__(
        self,
        modules: Sequence[Module],
        uid: int = 0xC15C0001,
        short_id: int = 1,
        *,
        phase: Phase = Phase.BOOTLOADER,
        details_channels: int | None = NAMES,
        versions: Mapping[int, str] = VERSIONS,
    ) -> None:
        """`phase`: after power-on; RUNNING is a hub that something else has started.
        `details_channels`: what MODULE_DETAILS tells of each module; None: what it sends.
        `versions`: by command."""
        self.uid = uid
        self._built = list(modules), short_id, phase
        self._details_channels = details_channels
        self._versions = versions
        self.reboot()

    def reboot(self) -> None:
        """Begin as after power-on: the host's settings are lost."""
        modules, self.short_id, self.phase = self._built
        self.modules = list(modules)
        self.period_ms = DEFAULT_PERIOD_MS
        self.auto_sync = False
        self._next_s: float | None = None  # time of the next scan while it streams

    def due(self, now_s: float) -> bool:
        """Whether a scan is to be sent now; a late caller skips scans, as an acquisition would."""
        if not self.auto_sync or self.phase < Phase.RUNNING:
            self._next_s = None
            return False
        if self._next_s is None:
            self._next_s = now_s
        if now_s < self._next_s - BRIEF_S:
            return False
        period = self.period_ms / 1000.0
        self._next_s += period * (1 + max((now_s - self._next_s) // period, 0.0))
        return True

    def sensor_data(self, counts: Sequence[int | None]) -> Iterator[Answer]:
        """The packets of one scan: `counts` channel by channel, all modules, 0..65535. For a count
        of None, as of a module that has died, the hub sends nothing."""
        places = [(m, c) for m, module in enumerate(self.modules) for c in range(module.channels)]
        if len(counts) != len(places):
            raise ValueError(f"{len(counts)} counts for {len(places)} channels")
        for at, values in _runs(counts):
            yield Command.SENSOR_DATA, struct.pack(f">BB{len(values)}H", *places[at], *values)

    def answer(self, packet: Packet) -> list[Answer]:
        """The hub's answers to a request; none if it is for another hub."""
        if packet.ihb not in (self.short_id, BROADCAST) or packet.command == Command.ERROR:
            return []
        if packet.command == LEAVE_BOOTLOADER:
            self.phase = max(self.phase, Phase.MODULES)
            return []
        if packet.command not in OBEYED | self._versions.keys():
            return [_error(packet.command, ErrorCode.NOT_SUPPORTED)]
        command = Command(packet.command)
        fields = commands.parse_request(command, packet.payload)
        if fields is None:
            return [_error(command, ErrorCode.FORMAT)]
        if command == Command.DISCOVERY_RECV_ID and fields["uid"] != self.uid:
            return []
        is_late = command in LATE and fields.get("on") != 0
        if self.phase < Phase.RUNNING and is_late:
            return [_error(command, ErrorCode.PHASE)]
        error = self._apply(command, fields)
        return [_error(command, error)] if error else self._report(command, fields)

    def _apply(self, command: Command, fields: commands.Fields) -> ErrorCode | None:
        """Do what a request asks for; → why not, where it cannot be done."""
        module = fields.get("module", ALL_MODULES)
        if module != ALL_MODULES and module >= len(self.modules):
            return ErrorCode.INVALID
        match command:
            case Command.DISCOVERY_RECV_ID:
                if fields["short_id"] in (0, BROADCAST):
                    return ErrorCode.INVALID
                self.short_id = fields["short_id"]
            case Command.MODULE_PROGRAM_END:
                if self.phase < Phase.MODULES:
                    return ErrorCode.PHASE
                self.phase = Phase.RUNNING
            case Command.SET_AUTO_SYNC:
                self.auto_sync = bool(fields["on"])
            case Command.SET_AUTO_SYNC_PERIOD:
                if not fields["period_ms"]:
                    return ErrorCode.INVALID
                self.period_ms = fields["period_ms"]
            case Command.MODULE_SET_CUT_SENSORS:
                if fields["cut"] > ALL_NAMES:
                    return ErrorCode.INVALID
                mask = ALL_NAMES & ~fields["cut"]
                for i in range(len(self.modules)) if module == ALL_MODULES else [module]:
                    self.modules[i] = replace(self.modules[i], mask=mask, channels=mask.bit_count())
            case Command.IHB_COLD_REBOOT:
                self.reboot()
        return None

    def _report(self, command: Command, fields: commands.Fields) -> list[Answer]:
        """The answers to a request that was done."""
        match command:
            case Command.DISCOVERY_PING:
                return [(command, commands.answer(command, uid=self.uid))]
            case Command.DISCOVERY_RECV_ID:
                return [(command, b"")]
            case Command.DECLARE:
                return [(command, self._declaration())]
            case _ if command in self._versions:
                return [(command, self._versions[command].encode())]
            case Command.MODULE_DETAILS:
                wanted = fields["module"]
                return [
                    (command, self._details(i, module))
                    for i, module in enumerate(self.modules)
                    if wanted in (i, ALL_MODULES)
                ]
        return []

    def _declaration(self) -> bytes:
        if self.phase < Phase.RUNNING:
            return bytes((len(self.modules),))
        return bytes((len(self.modules), 0, *(module.channels for module in self.modules)))

    def _details(self, index: int, module: Module) -> bytes:
        if self.phase < Phase.RUNNING:
            return struct.pack(">BI", index, module.sui)
        return details(index, module, self._details_channels)


def details(index: int, module: Module, channels: int | None = None) -> bytes:
    """The MODULE_DETAILS answer of a module whose serial number is known; it tells `channels` where
    given, else the number that the module sends."""
    told = module if channels is None else replace(module, channels=channels)
    return commands.answer(Command.MODULE_DETAILS, module=index, **asdict(told))


def _runs(counts: Sequence[int | None]) -> Iterator[tuple[int, list[int]]]:
    """Runs of counts without a gap, no longer than a packet holds, each with its first place."""
    run: list[int] = []
    for at, value in enumerate([*counts, None]):
        if run and (value is None or len(run) == MAX_VALUES):
            yield at - len(run), run
            run = []
        if value is not None:
            run.append(value)


def _error(command: int, code: ErrorCode) -> Answer:
    return Command.ERROR, commands.answer(Command.ERROR, failed=command, error=code)
