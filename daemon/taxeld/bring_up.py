"""Bring-up of a CySkin bus: discovery → short ids → DECLARE and DETAILS → period → auto sync.

Pure: packets and the time in, requests out. Requests are broadcast, so that they never cut into the
fragments that a hub is sending under its own id. When scans stop, the whole sequence runs again,
which serves a hub that rebooted as well as one plugged in late.
"""

import math
from collections.abc import Iterable

from taxeld_protocol import commands
from taxeld_protocol.cyskin import ALL_MODULES, Command, Packet
from taxeld_protocol.decoder import Decoder

RETRY_S = 0.5
SILENCE_S = 1.0  # without a scan for so long, the hubs are asked anew

Request = tuple[int, bytes]


class BringUp:
    """Decides what to send to get scans and to keep them coming."""

    def __init__(self, decoder: Decoder, period_ms: int) -> None:
        self._decoder = decoder
        self._period_ms = period_ms
        self._short_ids: dict[int, int] = {}  # hub UID → the id it was given
        self._next_s = -math.inf
        self._known = False  # whether the last requests went out with the modules known
        self._last_scan_s = -math.inf

    def restart(self) -> None:
        """Begin again at once: the device was opened anew."""
        self._last_scan_s = -math.inf
        self._next_s = -math.inf
        self._known = False

    def on_packet(self, packet: Packet) -> list[Request]:
        """A hub that answers discovery is given its short id."""
        if packet.command != Command.DISCOVERY_PING:
            return []
        fields = commands.parse_answer(packet.command, packet.payload)
        if fields is None:  # the request, as another host sent it
            return []
        uid = fields["uid"]
        short_id = self._short_ids.setdefault(uid, len(self._short_ids) + 1)
        if packet.ihb == short_id or short_id > 0xFE:
            return []
        return [_request(Command.DISCOVERY_RECV_ID, uid=uid, short_id=short_id)]

    def on_scan(self, now_s: float) -> None:
        self._last_scan_s = now_s

    def due(self, now_s: float) -> Iterable[Request]:
        """The requests to send now."""
        if now_s - self._last_scan_s < SILENCE_S:
            return []
        just_known = self._ready and not self._known
        if now_s < self._next_s and not just_known:
            return []
        self._next_s = now_s + RETRY_S
        self._known = self._ready
        if self._known:
            return [
                _request(Command.SET_AUTO_SYNC_PERIOD, period_ms=self._period_ms),
                _request(Command.SET_AUTO_SYNC, on=1),
                _request(Command.DISCOVERY_PING),  # a hub that rebooted has lost its id
            ]
        return [
            _request(Command.DISCOVERY_PING),
            _request(Command.DECLARE),
            _request(Command.MODULE_DETAILS, module=ALL_MODULES),
        ]

    @staticmethod
    def stop() -> list[Request]:
        return [_request(Command.SET_AUTO_SYNC, on=0)]

    @property
    def _ready(self) -> bool:
        hubs = self._decoder.hubs.values()
        return bool(hubs) and all(hub.table.detailed for hub in hubs)


def _request(command: Command, **fields: int) -> Request:
    return command, commands.request(command, **fields)
