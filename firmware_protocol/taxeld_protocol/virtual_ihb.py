"""A virtual hub: answers requests as a CySkin IHB does and turns counts into SENSOR_DATA.

It begins as a hub that was just powered. Its own bootloader is left by LEAVE_BOOTLOADER, and then
that of its modules by MODULE_PROGRAM_END. Until their application runs it declares no channels, and
sends no scan.
"""

import struct
from collections.abc import Iterator, Sequence
from dataclasses import replace
from enum import IntEnum

from taxeld_protocol import commands, cyskin
from taxeld_protocol.commands import COMM_SPEEDS_MBPS, CdcControl, CdcSpeed, Grouping
from taxeld_protocol.cyskin import (
    ALL_MODULES,
    BROADCAST,
    KNOWN_COMMANDS,
    LEAVE_BOOTLOADER,
    MAX_VALUES,
    Command,
    ErrorCode,
    Packet,
    Reassembler,
)
from taxeld_protocol.frames import Frame
from taxeld_protocol.modules import (
    ALL_NAMES,
    NAMES,
    Module,
    encode_bootloader_details,
    encode_details,
)

DEFAULT_PERIOD_MS = 50
VERSION = b"taxeld virtual IHB 1"

Answer = tuple[int, bytes]  # command, payload


class Phase(IntEnum):
    """How far a hub is after power-on."""

    BOOTLOADER = 0  # its own
    MODULES = 1  # its application runs, its modules are in their bootloader
    RUNNING = 2


# What a hub does before its modules run
EARLY = frozenset({
    LEAVE_BOOTLOADER, Command.DISCOVERY_PING, Command.DISCOVERY_RECV_ID, Command.PING,
    Command.MODULE_PROGRAM_END, Command.IHB_COLD_REBOOT, Command.IHB_WARM_REBOOT,
    Command.MODULE_COLD_REBOOT, Command.DECLARE, Command.MODULE_DETAILS, Command.VERSION,
    Command.MODULE_BTLDR_VERSION, Command.UID,
})  # fmt: skip


class HubLink(Reassembler):
    """A hub's end of the bus: the frame that ends its bootloader is a request like others."""

    def feed(self, frame: Frame) -> Packet | None:
        if frame.extended and frame[1:3] == (cyskin.BOOTLOADER_ID, cyskin.BOOTLOADER_EXIT):
            return Packet(frame.t, BROADCAST, LEAVE_BOOTLOADER, b"")
        return super().feed(frame)


class VirtualIhb:
    """One hub with its modules; no clock and no transport: its owner asks `due` and sends."""

    auto_sync: bool
    _sync_once: bool
    _next_s: float | None

    def __init__(
        self,
        modules: Sequence[Module],
        uid: int = 0xC15C0001,
        short_id: int = 1,
        *,
        phase: Phase = Phase.BOOTLOADER,
        details_channels: int | None = NAMES,
    ) -> None:
        """`phase`: after power-on; RUNNING is a hub that something else has started.
        `details_channels`: what MODULE_DETAILS tells of each module; None: what it sends."""
        self.uid = uid
        self._built = list(modules), short_id, phase
        self._details_channels = details_channels
        self.reboot()

    def reboot(self) -> None:
        """As after power-on: what the host set is lost."""
        modules, self.short_id, self.phase = self._built
        self.modules = list(modules)
        self._reset()

    def due(self, now_s: float) -> bool:
        """Whether a scan is to be sent now; a late caller skips scans, as an acquisition would."""
        if self._sync_once:
            self._sync_once = False
            return True
        if not self.auto_sync or self.phase < Phase.RUNNING:
            self._next_s = None
            return False
        if self._next_s is None:
            self._next_s = now_s
        if now_s < self._next_s:
            return False
        period = self.period_ms / 1000.0
        self._next_s += period * (1 + (now_s - self._next_s) // period)
        return True

    def sensor_data(self, counts: Sequence[int | None]) -> Iterator[Answer]:
        """The packets of one scan: `counts` channel by channel, all modules, 0..65535; where they
        are None, as of a module that has died, the hub has nothing to send."""
        places = [(m, c) for m, module in enumerate(self.modules) for c in range(module.channels)]
        if len(counts) != len(places):
            raise ValueError(f"{len(counts)} counts for {len(places)} channels")
        for at, values in _runs(counts):
            yield Command.SENSOR_DATA, struct.pack(f">BB{len(values)}H", *places[at], *values)

    def answer(self, packet: Packet) -> list[Answer]:
        """What the hub says to a request; nothing if it is for another hub."""
        if packet.ihb not in (self.short_id, BROADCAST) or packet.command == Command.ERROR:
            return []
        if packet.command == LEAVE_BOOTLOADER:
            self.phase = max(self.phase, Phase.MODULES)
            return []
        if packet.command not in KNOWN_COMMANDS:
            return [_error(packet.command, ErrorCode.NOT_SUPPORTED)]
        command = Command(packet.command)
        fields = commands.parse_request(command, packet.payload)
        if fields is None:
            return [_error(command, ErrorCode.FORMAT)]
        if command == Command.DISCOVERY_RECV_ID and fields["uid"] != self.uid:
            return []
        if self.phase < Phase.RUNNING and not _is_early(command, fields):
            return [_error(command, ErrorCode.PHASE)]
        error = self._apply(command, fields)
        return [_error(command, error)] if error else self._report(command, fields)

    def _reset(self) -> None:
        """What the hub's application begins with."""
        self.period_ms = DEFAULT_PERIOD_MS
        self.comm_speed_mbps = COMM_SPEEDS_MBPS[0]
        self._stop()

    def _stop(self) -> None:
        self.auto_sync = False
        self._sync_once = False
        self._next_s = None

    def _apply(self, command: Command, fields: commands.Fields) -> ErrorCode | None:
        """Do what a request asks for."""
        match command:
            case Command.DISCOVERY_RECV_ID:
                if fields["short_id"] in (0, BROADCAST):
                    return ErrorCode.INVALID
                self.short_id = fields["short_id"]
            case Command.MODULE_PROGRAM_END:
                if self.phase < Phase.MODULES:
                    return ErrorCode.PHASE
                self.phase = Phase.RUNNING
            case Command.MODULE_COLD_REBOOT:
                self.phase = min(self.phase, Phase.MODULES)
                self._stop()
            case Command.SET_AUTO_SYNC:
                self.auto_sync = bool(fields["on"])
            case Command.SET_AUTO_SYNC_PERIOD:
                if not fields["period_ms"]:
                    return ErrorCode.INVALID
                self.period_ms = fields["period_ms"]
            case Command.SYNC:
                self._sync_once = True
            case Command.SET_COMM_SPEED:
                if fields["mbps"] not in COMM_SPEEDS_MBPS:
                    return ErrorCode.INVALID
                self.comm_speed_mbps = fields["mbps"]
            case Command.IHB_COLD_REBOOT:
                self.reboot()
            case Command.IHB_WARM_REBOOT:
                self._reset()
            case _ if "module" in fields:
                return self._apply_to_modules(command, fields)
        return None

    def _apply_to_modules(self, command: Command, fields: commands.Fields) -> ErrorCode | None:
        module = fields["module"]
        if module != ALL_MODULES and module >= len(self.modules):
            return ErrorCode.INVALID
        change: dict[str, int] = {}
        match command:
            case Command.SET_MODULE_GROUPING if fields["grouping"] in list(Grouping):
                change = {"grouping": fields["grouping"]}
            case Command.MODULE_CDC_CONTROL if fields["control"] in list(CdcControl):
                change = {"cdc_control": fields["control"]}
            case Command.MODULE_CDC_SPEED if fields["speed"] in list(CdcSpeed):
                change = {"cdc_speed": fields["speed"]}
            case Command.MODULE_SET_CUT_SENSORS if fields["cut"] <= ALL_NAMES:
                mask = ALL_NAMES & ~fields["cut"]
                change = {"mask": mask, "channels": mask.bit_count()}
            case Command.MODULE_DETAILS:
                return None
            case _:
                return ErrorCode.INVALID
        chosen = range(len(self.modules)) if module == ALL_MODULES else [module]
        for i in chosen:
            self.modules[i] = replace(self.modules[i], **change)
        return None

    def _report(self, command: Command, fields: commands.Fields) -> list[Answer]:
        """What is answered to a request that was done."""
        match command:
            case Command.DISCOVERY_PING | Command.UID:
                return [(command, commands.answer(command, uid=self.uid))]
            case Command.DISCOVERY_RECV_ID | Command.PING:
                return [(command, b"")]
            case Command.GET_COMM_SPEED:
                return [(command, commands.answer(command, mbps=self.comm_speed_mbps))]
            case Command.VERSION | Command.MODULE_BTLDR_VERSION | Command.MODULE_APP_VERSION:
                return [(command, VERSION)]
            case Command.DECLARE:
                return [(command, self._declaration())]
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
            return encode_bootloader_details(index, module)
        return encode_details(index, module, channels=self._details_channels)


def _is_early(command: Command, fields: commands.Fields) -> bool:
    """Whether a request is done before the modules run: to be silent costs nothing."""
    return command in EARLY or (command == Command.SET_AUTO_SYNC and not fields["on"])


def _runs(counts: Sequence[int | None]) -> Iterator[tuple[int, list[int]]]:
    """Where counts stand without a gap, and those, no more than a packet holds."""
    run: list[int] = []
    for at, value in enumerate([*counts, None]):
        if run and (value is None or len(run) == MAX_VALUES):
            yield at - len(run), run
            run = []
        if value is not None:
            run.append(value)


def _error(command: int, code: ErrorCode) -> Answer:
    return Command.ERROR, commands.answer(Command.ERROR, failed=command, error=code)
