"""A virtual hub: answers requests as a CySkin IHB does and turns counts into SENSOR_DATA."""

import struct
from collections.abc import Iterator, Sequence

from taxeld_protocol.cyskin import (
    ALL_MODULES,
    BROADCAST,
    MAX_VALUES,
    Command,
    ErrorCode,
    Packet,
)
from taxeld_protocol.modules import Module, encode_details

DEFAULT_PERIOD_MS = 50
VERSION = b"taxeld virtual IHB 1"

Answer = tuple[int, bytes]  # command, payload


class VirtualIhb:
    """One hub with its modules; no clock and no transport: its owner asks `due` and sends."""

    def __init__(self, modules: Sequence[Module], uid: int = 0xC15C0001, short_id: int = 1) -> None:
        self.modules = list(modules)
        self.uid = uid
        self.short_id = short_id
        self.period_ms = DEFAULT_PERIOD_MS
        self.auto_sync = False
        self._sync_once = False
        self._next_s: float | None = None

    def due(self, now_s: float) -> bool:
        """Whether a scan is to be sent now; a late caller skips scans, as an acquisition would."""
        if self._sync_once:
            self._sync_once = False
            return True
        if not self.auto_sync:
            self._next_s = None
            return False
        if self._next_s is None:
            self._next_s = now_s
        if now_s < self._next_s:
            return False
        period = self.period_ms / 1000.0
        self._next_s += period * (1 + (now_s - self._next_s) // period)
        return True

    def sensor_data(self, counts: Sequence[int]) -> Iterator[Answer]:
        """The packets of one scan: `counts` channel by channel, all modules, 0..65535."""
        places = [(m, c) for m, module in enumerate(self.modules) for c in range(module.channels)]
        if len(counts) != len(places):
            raise ValueError(f"{len(counts)} counts for {len(places)} channels")
        for at in range(0, len(places), MAX_VALUES):
            values = counts[at : at + MAX_VALUES]
            yield Command.SENSOR_DATA, struct.pack(f">BB{len(values)}H", *places[at], *values)

    def answer(self, packet: Packet) -> list[Answer]:
        """What the hub says to a request; nothing if it is for another hub."""
        if packet.ihb not in (self.short_id, BROADCAST):
            return []
        command, payload = packet.command, packet.payload
        match command:
            case Command.DISCOVERY_PING:
                return [(command, struct.pack(">I", self.uid))]
            case Command.DISCOVERY_RECV_ID:
                return self._take_short_id(payload)
            case Command.PING | Command.MODULE_PROGRAM_END:
                return [(command, b"")]
            case Command.UID:
                return [(command, struct.pack(">I", self.uid))]
            case Command.VERSION | Command.MODULE_BTLDR_VERSION | Command.MODULE_APP_VERSION:
                return [(command, VERSION)]
            case Command.DECLARE:
                channels = bytes(module.channels for module in self.modules)
                return [(command, bytes((len(channels), 0)) + channels)]
            case Command.MODULE_DETAILS:
                return self._details(payload)
            case Command.SET_AUTO_SYNC:
                if len(payload) != 1:
                    return [_error(command, ErrorCode.FORMAT)]
                self.auto_sync = bool(payload[0])
                return []
            case Command.SET_AUTO_SYNC_PERIOD:
                return self._set_period(payload)
            case Command.SYNC:
                self._sync_once = True
                return []
            case Command.ERROR:
                return []
        return [_error(command, ErrorCode.NOT_SUPPORTED)]

    def _take_short_id(self, payload: bytes) -> list[Answer]:
        if len(payload) != 5:
            return [_error(Command.DISCOVERY_RECV_ID, ErrorCode.FORMAT)]
        uid, short_id = struct.unpack(">IB", payload)
        if uid != self.uid:
            return []
        if short_id in (0, BROADCAST):
            return [_error(Command.DISCOVERY_RECV_ID, ErrorCode.INVALID)]
        self.short_id = short_id
        return [(Command.DISCOVERY_RECV_ID, b"")]

    def _details(self, payload: bytes) -> list[Answer]:
        if len(payload) != 1:
            return [_error(Command.MODULE_DETAILS, ErrorCode.NO_ARGUMENT)]
        wanted = range(len(self.modules)) if payload[0] == ALL_MODULES else [payload[0]]
        if wanted[-1] >= len(self.modules):
            return [_error(Command.MODULE_DETAILS, ErrorCode.INVALID)]
        return [(Command.MODULE_DETAILS, encode_details(i, self.modules[i])) for i in wanted]

    def _set_period(self, payload: bytes) -> list[Answer]:
        if len(payload) != 2:
            return [_error(Command.SET_AUTO_SYNC_PERIOD, ErrorCode.FORMAT)]
        (period_ms,) = struct.unpack(">H", payload)
        if period_ms == 0:
            return [_error(Command.SET_AUTO_SYNC_PERIOD, ErrorCode.INVALID)]
        self.period_ms = period_ms
        return []


def _error(command: int, code: ErrorCode) -> Answer:
    return Command.ERROR, bytes((command, code))
