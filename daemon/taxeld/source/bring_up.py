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
OTHERS_RETRY_S = 5.0  # where only some of the hubs are silent
SHORT_IDS = 254  # that can be given
RENAMED_TRIES = 10  # for the table of a hub that was given another short id

Request = tuple[int, bytes]


class BringUp:
    """Decides what to send to get scans and to keep them coming."""

    waits_for = ""

    def __init__(self, decoder: Decoder, period_ms: int) -> None:
        self._decoder = decoder
        self._period_ms = period_ms
        self._short_ids: dict[int, int] = {}  # hub UID → the id it was given
        self._unsure: set[int] = set()  # ids that were given and not yet acknowledged
        self._misnamed: set[int] = set()  # ids whose tables may be another hub's, once all are sure
        self._renamed: dict[int, int] = {}  # ids whose table is asked for anew → tries left
        self._next_s = -math.inf
        self._known = False  # whether the last requests went out with the modules known
        self._scan_s: dict[int, float] = {}  # short id → its last scan

    def restart(self) -> None:
        """Begin again at once: the device was opened anew."""
        self._scan_s.clear()
        self._next_s = -math.inf
        self._known = False

    def on_packet(self, packet: Packet) -> list[Request]:
        """A hub that answers discovery is given its short id."""
        if packet.command == Command.DISCOVERY_RECV_ID and not packet.payload:
            self._is_named(packet.ihb)
        if packet.command != Command.DISCOVERY_PING:
            return []
        fields = commands.parse_answer(packet.command, packet.payload)
        if fields is None:  # the request, as another host sent it
            return []
        uid = fields["uid"]
        if uid not in self._short_ids and len(self._short_ids) >= SHORT_IDS:
            return []  # no id is left for it
        short_id = self._short_ids.setdefault(uid, len(self._short_ids) + 1)
        if packet.ihb == short_id:
            self._is_named(short_id)
            return []
        self._unsure.add(short_id)
        self._misnamed |= {packet.ihb, short_id}
        return [_request(Command.DISCOVERY_RECV_ID, uid=uid, short_id=short_id)]

    def on_scan(self, ihb: int, now_s: float) -> None:
        self._scan_s[ihb] = now_s

    def due(self, now_s: float) -> Iterable[Request]:
        """The requests to send now."""
        silent = [ihb for ihb, last_s in self._scan_s.items() if now_s - last_s >= SILENCE_S]
        some_speak = len(silent) < len(self._scan_s)
        if some_speak and not (silent or self._unsure or self._renamed):
            return []
        just_known = self._ready and not self._known
        if now_s < self._next_s and not just_known:
            return []
        self._next_s = now_s + (OTHERS_RETRY_S if some_speak and silent else RETRY_S)
        self._known = self._ready
        self._renamed = {
            ihb: n - 1 for ihb, n in self._renamed.items() if n > 1 and not self._known
        }
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

    def _is_named(self, short_id: int) -> None:
        """A hub has its id. Once all have, what was declared under ids that changed hands is
        forgotten, with all that was on its way then, and asked for anew."""
        self._unsure.discard(short_id)
        if self._unsure or not self._misnamed:
            return
        for ihb in self._misnamed:
            self._decoder.forget(ihb)
            self._scan_s.pop(ihb, None)
        self._renamed = dict.fromkeys(self._misnamed & set(self._short_ids.values()), RENAMED_TRIES)
        self._misnamed = set()
        self._known = False
        self._next_s = -math.inf

    @staticmethod
    def stop() -> list[Request]:
        return [_request(Command.SET_AUTO_SYNC, on=0)]

    @property
    def _ready(self) -> bool:
        hubs = {*self._decoder.hubs, *self._renamed}
        return bool(hubs) and all(self._decoder.table(ihb).detailed for ihb in hubs)


def _request(command: Command, **fields: int) -> Request:
    return command, commands.request(command, **fields)
