"""Bring-up of a CySkin bus, in the order of the vendor's own library.

Out of the hubs' bootloader → discovery and short ids → DECLARE and DETAILS → auto sync off, and the
modules out of their bootloader → discovery, DECLARE and DETAILS again → period → auto sync on.

Pure: packets and the time in, requests out. Requests are broadcast, so that they never cut into the
fragments that a hub is sending under its own id. When scans stop, the whole sequence runs again,
for a hub that rebooted as well as for one plugged in late; hubs that speak meanwhile are not told
to stop.
"""

import math
from collections.abc import Iterable
from enum import IntEnum

from taxeld_protocol import commands
from taxeld_protocol.cyskin import ALL_MODULES, BROADCAST, LEAVE_BOOTLOADER, Command, Packet
from taxeld_protocol.decoder import Decoder
from taxeld_protocol.modules import is_of_bootloader

RETRY_S = 0.5  # time for the answers to a step
SILENCE_S = 1.0  # time without a scan after which the hubs are asked anew
SILENT_PERIODS = 3  # scan periods of silence before hubs are asked anew, if longer than SILENCE_S
OTHERS_RETRY_S = 5.0  # time between rounds where only some of the hubs are silent
STARTING_TRIES = 3  # tries to hear channels declared: modules take time to leave their bootloader
STUCK_S = 10.0  # time in the bootloader after which a hub is reported: no module needs as long
SHORT_IDS = 254  # short ids that can be given

Request = tuple[int, bytes]


class RoundStep(IntEnum):
    """Steps of a round: the requests sent, and the answers that end the step."""

    REST = 0  # nothing is sent
    FIND = 1  # leave the bootloader, discovery: until all hubs that answer have their short ids
    ASK = 2  # DECLARE, DETAILS: until all hubs have answered, also from the bootloader
    START = 3  # auto sync off, modules' applications, discovery: until all hubs have answered
    ASK_AGAIN = 4  # DECLARE, DETAILS: until all channels are known
    STREAM = 5  # period, auto sync on: until scans come


class BringUp:
    """Decides what to send to get scans and to keep them coming."""

    waits_for = ""

    def __init__(self, decoder: Decoder, period_ms: int) -> None:
        self.waits_for = ""  # a line on missing answers without which not all scans come; or empty
        self._decoder = decoder
        self._period_ms = period_ms
        self._patience_s = SILENT_PERIODS * period_ms / 1000.0
        self._scan_s: dict[int, float] = {}  # short id → time of its last scan
        self._short_ids: dict[int, int] = {}  # hub UID → its short id
        self._unsure: set[int] = set()  # ids that were given and are not acknowledged yet
        self._misnamed: set[int] = set()  # ids whose tables may be another hub's
        self._step = RoundStep.REST
        self._until_s = -math.inf  # time when the step is given up
        self._anew = True  # whether no hub was sending when the round began
        self._tries = 0  # tries left
        self._found: set[int] = set()  # ids of the hubs that discovery found in this round
        self._answered: set[int] = set()  # ids of the hubs that answered discovery in this step
        self._told: set[int] = set()  # ids of the hubs that answered DECLARE in this step
        self._cold: dict[int, float] = {}  # id of a hub in its bootloader → time since when
        self._news: list[str] = []
        self._now_s = -math.inf

    def restart(self) -> None:
        """Begin again at once, because the device was opened again."""
        self._scan_s.clear()
        self._begin()

    def news(self) -> list[str]:
        """Lines on events since the last call."""
        news, self._news = self._news, []
        return news

    def on_packet(self, packet: Packet) -> list[Request]:
        """Take a packet. A hub that answers discovery gets its short id, whatever id it has, as in
        the vendor's library."""
        if packet.command == Command.DISCOVERY_RECV_ID and not packet.payload:
            self._is_named(packet.ihb)
        elif packet.command == Command.DECLARE and packet.payload and packet.ihb != BROADCAST:
            self._told.add(packet.ihb)
            self._note_bootloader(packet)
        elif packet.command == Command.DISCOVERY_PING:
            return self._name(packet)
        return []

    def on_scan(self, ihb: int, now_s: float) -> None:
        self._scan_s[ihb] = now_s

    def due(self, now_s: float) -> Iterable[Request]:
        """The requests to send now."""
        self._now_s = now_s
        self.waits_for = self._stuck()
        if self._step in (RoundStep.REST, RoundStep.STREAM):
            speaking = self._speaking()
            if speaking and speaking >= {*self._scan_s, *self._found, *self._unsure}:
                self._step = RoundStep.REST
                return []
            if not speaking and not self._anew:  # the hubs that were sending have fallen silent too
                self._begin()
        if now_s < self._until_s and not self._is_done():
            return []
        self._enter(self._next())
        return self._requests()

    @staticmethod
    def stop() -> list[Request]:
        return [_request(Command.SET_AUTO_SYNC, on=0)]

    def _speaking(self) -> set[int]:
        silence_s = max(SILENCE_S, self._patience_s)
        return {ihb for ihb, last_s in self._scan_s.items() if self._now_s - last_s < silence_s}

    def _begin(self) -> None:
        """Begin a round at once."""
        self._step, self._until_s = RoundStep.REST, -math.inf

    def _is_done(self) -> bool:
        """Whether a step has reached its end."""
        match self._step:
            case RoundStep.FIND | RoundStep.START:
                return bool(self._found) and self._found <= self._answered and not self._unsure
            case RoundStep.ASK:
                return bool(self._told) and self._found <= self._told
            case RoundStep.ASK_AGAIN:
                known = all(map(self._is_known, self._found | self._told))
                return bool(self._told) and known
        return False

    def _is_known(self, ihb: int) -> bool:
        """Whether a hub has declared its channels in this step, and the modules they belong to."""
        table = self._decoder.table(ihb)
        return ihb in self._told and table.complete and not table.in_bootloader

    def _next(self) -> RoundStep:
        """The step after one that is done, or that took too long."""
        match self._step:
            case RoundStep.FIND if self._found:
                return RoundStep.ASK
            case RoundStep.ASK:
                return RoundStep.START
            case RoundStep.START:
                return RoundStep.ASK_AGAIN
            case RoundStep.ASK_AGAIN if self._is_done() or not self._tries:
                if any(map(self._is_known, self._told)):
                    return RoundStep.STREAM  # the other hubs are asked again in the next round
            case RoundStep.ASK_AGAIN if self._told:
                return RoundStep.ASK_AGAIN
        in_vain = self._step in (RoundStep.FIND, RoundStep.ASK_AGAIN)
        return RoundStep.REST if in_vain and not self._anew else RoundStep.FIND

    def _enter(self, step: RoundStep) -> None:
        wait_s = RETRY_S
        match step:
            case RoundStep.REST:
                wait_s = OTHERS_RETRY_S
            case RoundStep.FIND:
                self._anew = not self._speaking()
                self._found, self._answered = set(), set()
            case RoundStep.START:
                self._answered = set()
                self._tries = STARTING_TRIES
            case RoundStep.ASK:
                self._told = set()
            case RoundStep.ASK_AGAIN:
                self._told = set()
                self._tries -= 1
            case RoundStep.STREAM:
                wait_s = max(RETRY_S, self._patience_s) if self._anew else OTHERS_RETRY_S
        self._step, self._until_s = step, self._now_s + wait_s

    def _requests(self) -> list[Request]:
        """The first requests of a step."""
        find = _request(Command.DISCOVERY_PING)
        match self._step:
            case RoundStep.FIND:
                return [(LEAVE_BOOTLOADER, b""), find]
            case RoundStep.ASK | RoundStep.ASK_AGAIN:
                details = _request(Command.MODULE_DETAILS, module=ALL_MODULES)
                return [_request(Command.DECLARE), details]
            case RoundStep.START:
                start = [_request(Command.MODULE_PROGRAM_END)]
                if self._anew:
                    return [_request(Command.SET_AUTO_SYNC, on=0), *start, find]
                return [*(start if self._cold else []), find]
            case RoundStep.STREAM:
                period = _request(Command.SET_AUTO_SYNC_PERIOD, period_ms=self._period_ms)
                return [period, _request(Command.SET_AUTO_SYNC, on=1)]
        return []

    def _name(self, packet: Packet) -> list[Request]:
        """Give a short id to a hub that answered discovery."""
        fields = commands.parse_answer(packet.command, packet.payload)
        if fields is None:  # a request from another host
            return []
        uid = fields["uid"]
        if uid not in self._short_ids and len(self._short_ids) >= SHORT_IDS:
            return []  # no id is left for this hub
        short_id = self._short_ids.setdefault(uid, len(self._short_ids) + 1)
        self._found.add(short_id)
        self._answered.add(short_id)
        if packet.ihb != short_id:
            self._misnamed |= {packet.ihb, short_id}
        else:
            self._is_named(short_id)
            if self._step in (RoundStep.REST, RoundStep.STREAM):  # another host asked
                return []
        self._unsure.add(short_id)
        return [_request(Command.DISCOVERY_RECV_ID, uid=uid, short_id=short_id)]

    def _is_named(self, short_id: int) -> None:
        """A hub has its id. Once all have theirs, tables declared under ids that changed hands are
        dropped with the packets then on their way, and asked for anew."""
        self._unsure.discard(short_id)
        if self._unsure or not self._misnamed:
            return
        for ihb in self._misnamed:
            self._decoder.forget(ihb)
            self._scan_s.pop(ihb, None)
            self._cold.pop(ihb, None)
        self._misnamed = set()
        if self._step in (RoundStep.ASK, RoundStep.ASK_AGAIN):
            self._step = RoundStep(self._step - 1)
            self._answered |= self._found
        elif self._step in (RoundStep.REST, RoundStep.STREAM):
            self._begin()

    def _note_bootloader(self, packet: Packet) -> None:
        if not is_of_bootloader(packet.command, packet.payload):
            self._cold.pop(packet.ihb, None)
        elif packet.ihb not in self._cold:
            self._cold[packet.ihb] = self._now_s
            self._news.append(
                f"hub {packet.ihb} is in its bootloader, as after power-on; it is started"
            )

    def _stuck(self) -> str:
        """A line on a hub that stays in its bootloader; empty without one."""
        for ihb, since_s in self._cold.items():
            if self._now_s - since_s >= STUCK_S:
                return (
                    f"hub {ihb} stays in its bootloader: switch it off and on; if that does not "
                    "help, its modules lack their firmware"
                )
        return ""


def _request(command: Command, **fields: int) -> Request:
    return command, commands.request(command, **fields)
