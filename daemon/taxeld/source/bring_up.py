"""Bring-up of a CySkin bus, in the order of the vendor's own library and with its pauses.

Out of the hubs' bootloader → discovery and short ids → DECLARE and DETAILS → auto sync off, and the
modules out of their bootloader → discovery, DECLARE and DETAILS again → versions, asked once →
period → auto sync on.

Pure: packets and the time in, requests out. While no hub sends, requests are broadcast. While some
do, a hub or module that is missing is looked for every OTHERS_RETRY_S. All that the hubs that send
hear of it is discovery; the rest goes to each silent hub under its own id, and so never cuts into
the fragments that another is sending.
"""

import logging
import math
from collections import deque
from collections.abc import Iterable
from enum import IntEnum

from taxeld_protocol import commands
from taxeld_protocol.cyskin import (
    ALL_MODULES,
    BROADCAST,
    LEAVE_BOOTLOADER,
    Command,
    ErrorCode,
    Packet,
)
from taxeld_protocol.decoder import Decoder
from taxeld_protocol.modules import is_of_bootloader

RETRY_S = 0.5  # time for the answers to a step
SILENCE_S = 1.0  # time without a scan after which the hubs are asked anew
SILENT_PERIODS = 3  # scan periods of silence before hubs are asked anew, if longer than SILENCE_S
OTHERS_RETRY_S = 5.0  # time between rounds while some hubs send
STARTING_TRIES = 3  # tries to hear channels declared: modules take time to leave their bootloader
STUCK_S = 10.0  # time without a start after which a hub is reported: no module needs as long
SHORT_IDS = 254  # short ids that can be given
# The vendor's pauses: after a hub is led out of its bootloader, after auto sync is switched off,
# and after modules are led out of their bootloader.
LEFT_S, STOPPED_S, STARTED_S = 0.1, 0.06, 0.5
SETTLE_S = 0.1  # time in which all hubs answer discovery, as other hubs are sending
BUSY_S = 0.1  # pause before a request is made again that a hub could not take
BUSY_MOST_S = 1.0  # time from a step's begin in which its requests are made again
COLD = "is in its bootloader, as after power-on; it is started"
STUCK = (
    "stays in its bootloader: switch it off and on; if that does not help, its modules lack their "
    "firmware"
)
VERSIONS = {
    Command.VERSION: "version",
    Command.MODULE_BTLDR_VERSION: "bootloader",
    Command.MODULE_APP_VERSION: "application",
}
VERSION_S = 0.02  # time for an answer: a hub may have to ask its modules
VERSION_CHARACTERS = 32  # of a version, at most

log = logging.getLogger(__name__)

Request = tuple[int, int, bytes]  # short id of the hub that it is for, command, payload
Asked = tuple[Request, float]  # a request, and the pause after it


class RoundStep(IntEnum):
    """Steps of a round: the requests sent, and the answers that end the step."""

    REST = 0  # nothing is sent
    FIND = 1  # leave the bootloader, discovery: until all hubs that answer have their short ids
    ASK = 2  # DECLARE, DETAILS: until all hubs have answered, also from the bootloader
    START = 3  # auto sync off, modules' applications, discovery: until all hubs have answered
    ASK_AGAIN = 4  # DECLARE, DETAILS: until all channels are known
    STREAM = 5  # versions, period, auto sync on: until scans come


class BringUp:
    """Decides what to send to get scans and to keep them coming."""

    def __init__(self, decoder: Decoder, period_ms: int, suis: Iterable[int] = ()) -> None:
        """`suis`: serial numbers of the modules that are looked for until they are found."""
        self.waits_for = ""  # a line on missing answers without which not all scans come; or empty
        self._decoder = decoder
        self._period_ms = period_ms
        self._patience_s = max(RETRY_S, SILENT_PERIODS * period_ms / 1000.0)
        self._suis = set(suis)
        self._lacking = self._suis  # serial numbers that no hub has declared
        self._scan_s: dict[int, float] = {}  # short id → time of its last scan
        self._short_ids: dict[int, int] = {}  # hub UID → its short id
        self._unsure: set[int] = set()  # ids that were given and are not acknowledged yet
        self._misnamed: set[int] = set()  # ids whose tables may be another hub's
        self._versions: dict[int, dict[str, str]] = {}  # id of each hub that was asked → versions
        self._logged: set[int] = set()  # ids of the hubs whose versions the log has
        # id of a hub that does not start → since when, and a line on it
        self._late: dict[int, tuple[float, str]] = {}
        self._step = RoundStep.REST
        self._began_s = -math.inf  # time when the round began
        self._step_s = -math.inf  # time when the step began
        self._until_s = -math.inf  # time when the step is given up
        self._queue: deque[Asked] = deque()  # requests of this step that are still to be sent
        self._sent: list[Asked] = []  # its requests that were sent
        self._free_s = -math.inf  # time when the pause after the last of them ends
        self._tries = 0  # tries left
        self._spared: set[int] = set()  # ids of the hubs that were sending when the round began
        self._renamed = False  # whether another hub had the id of one of them
        self._found: set[int] = set()  # ids of the hubs that discovery found in this round
        self._answered: set[int] = set()  # ids of the hubs that answered discovery in this step
        self._told: set[int] = set()  # ids of the hubs that answered DECLARE in this step
        self._now_s = -math.inf

    @property
    def is_starting(self) -> bool:
        """Whether a hub has answered whose modules may still be silent for a while."""
        return bool(self._found) and RoundStep.FIND <= self._step <= RoundStep.ASK_AGAIN

    @property
    def firmware(self) -> dict[str, str]:
        """Short id of a hub → its firmware's versions, as far as it tells them."""
        return {
            str(ihb): ", ".join(f"{name} {text}" for name, text in found.items())
            for ihb, found in self._versions.items()
            if found
        }

    def restart(self) -> None:
        """Begin again at once, because the device was opened again."""
        self._scan_s.clear()
        self._begin()

    def on_packet(self, packet: Packet) -> None:
        """Take a packet. A hub that answers discovery gets its short id, whatever id it has, as in
        the vendor's library."""
        _, ihb, command, payload = packet
        if command == Command.DISCOVERY_RECV_ID and not payload:
            self._is_named(ihb)
        elif command == Command.DISCOVERY_PING:
            self._name(packet)
        elif not payload or ihb == BROADCAST:  # a request of another host
            return
        elif command == Command.ERROR:
            self._heed(packet)
        elif command in VERSIONS and ihb in self._versions:
            self._versions[ihb].setdefault(VERSIONS[Command(command)], _text(payload))
        elif command == Command.DECLARE:
            self._told.add(ihb)
            self._note_bootloader(packet)

    def on_scan(self, ihb: int, now_s: float) -> None:
        if ihb not in self._logged and str(ihb) in self.firmware:
            self._logged.add(ihb)
            log.info("hub %d: %s", ihb, self.firmware[str(ihb)])
        self._scan_s[ihb] = now_s
        self._late.pop(ihb, None)

    def due(self, now_s: float) -> list[Request]:
        """The requests to send now; a pause after one begins now."""
        self._now_s = now_s
        self.waits_for = self._decoder.refusal or self._stuck()
        if not self._queue:
            self._go_on()
        begin = len(self._sent)
        while self._queue and now_s >= self._free_s:
            self._sent.append(self._queue.popleft())
            self._free_s = now_s + self._sent[-1][1]
        return [request for request, _ in self._sent[begin:]]

    @staticmethod
    def stop() -> Request:
        return _request(Command.SET_AUTO_SYNC, on=0)

    def _go_on(self) -> None:
        if self._step in (RoundStep.REST, RoundStep.STREAM):
            speaking = self._speaking()
            wanted = {*self._scan_s, *self._short_ids.values(), *self._unsure} - self._refused()
            if speaking and speaking >= wanted and not self._lacking:
                self._step = RoundStep.REST
                return
            if not speaking and self._spared:  # the hubs that were sending have fallen silent too
                self._begin()
        if self._now_s >= self._until_s or self._is_done():
            self._enter(self._next())

    def _speaking(self) -> set[int]:
        silence_s = max(SILENCE_S, self._patience_s)
        return {ihb for ihb, last_s in self._scan_s.items() if self._now_s - last_s < silence_s}

    def _refused(self) -> set[int]:
        """Hubs that are not started, as their modules cannot be read."""
        return {ihb for ihb, hub in self._decoder.hubs.items() if hub.table.fault}

    def _not_declared(self) -> set[int]:
        tables = [hub.table for hub in self._decoder.hubs.values() if not hub.table.fault]
        return self._suis - {m.sui for table in tables for m in table.modules if m.channels}

    def _begin(self) -> None:
        self._step, self._until_s, self._free_s = RoundStep.REST, -math.inf, -math.inf
        self._queue.clear()

    def _awaited(self) -> set[int]:
        """Hubs whose answers end a step."""
        return self._found if self._renamed else self._found - self._spared

    def _is_done(self) -> bool:
        awaited = self._awaited()
        match self._step:
            case RoundStep.FIND | RoundStep.START:
                return bool(self._found) and awaited <= self._answered and not self._unsure
            case RoundStep.ASK:
                return bool(self._told) and awaited <= self._told
            case RoundStep.ASK_AGAIN:
                return bool(self._told) and all(map(self._is_known, awaited | self._told))
        return False

    def _is_known(self, ihb: int) -> bool:
        """Whether a hub has declared its channels in this step, and the modules they belong to."""
        table = self._decoder.table(ihb)
        return ihb in self._told and table.complete and not table.in_bootloader

    def _startable(self) -> list[int]:
        """Silent hubs that can be told to stream."""
        return sorted(filter(self._is_known, self._told - self._spared - self._refused()))

    def _next(self) -> RoundStep:
        """The step after one that is done, or that took too long."""
        awaited = self._awaited()
        match self._step:
            case RoundStep.FIND if awaited:
                return RoundStep.ASK
            case RoundStep.ASK if not self._spared or awaited & self._late.keys():
                return RoundStep.START
            case RoundStep.START:
                return RoundStep.ASK_AGAIN
            case RoundStep.ASK | RoundStep.ASK_AGAIN:
                at_end = not self._tries or all(map(self._is_known, awaited | self._told))
                if at_end and self._startable():
                    return RoundStep.STREAM  # the other hubs are asked again in the next round
                if not at_end:
                    return RoundStep.ASK_AGAIN
            case RoundStep.REST | RoundStep.STREAM:
                return RoundStep.FIND
        # in vain; hubs that are refused, or others that send, are not asked without a rest
        return RoundStep.REST if self._spared or self._refused() else RoundStep.FIND

    def _enter(self, step: RoundStep) -> None:
        now_s = self._now_s
        until_s = now_s + RETRY_S
        match step:
            case RoundStep.REST:
                until_s = self._began_s + OTHERS_RETRY_S
                self._lacking = self._not_declared()
            case RoundStep.FIND:
                self._began_s = now_s
                self._spared, self._renamed = self._speaking(), False
                self._found, self._answered = set(), set()
            case RoundStep.START:
                self._answered = set()
            case RoundStep.ASK:
                self._spared |= self._speaking()  # that a channel was closed made them silent
                self._told = set()
                self._tries = STARTING_TRIES
            case RoundStep.ASK_AGAIN:
                self._told = set()
                self._tries -= 1
            case RoundStep.STREAM:
                self._lacking = self._not_declared()
                rest_s = OTHERS_RETRY_S if self._spared else 0.0
                until_s = max(now_s + self._patience_s, self._began_s + rest_s)
        self._step, self._step_s = step, now_s
        self._queue, self._sent = deque(self._requests()), []
        self._until_s = until_s + sum(pause_s for _, pause_s in self._queue)

    def _requests(self) -> list[Asked]:
        find = _request(Command.DISCOVERY_PING)
        match self._step:
            case RoundStep.FIND:
                settle_s = SETTLE_S if self._spared else 0.0
                return [((BROADCAST, LEAVE_BOOTLOADER, b""), LEFT_S), (find, settle_s)]
            case RoundStep.ASK | RoundStep.ASK_AGAIN:
                everyone = self._renamed or not self._spared
                return [
                    (request, 0.0)
                    for to in ([BROADCAST] if everyone else sorted(self._awaited()))
                    for request in (
                        _request(Command.DECLARE, to),
                        _request(Command.MODULE_DETAILS, to, module=ALL_MODULES),
                    )
                ]
            case RoundStep.START:
                cold = sorted(self._awaited() & self._late.keys())
                *others, last = cold if self._spared else [BROADCAST]
                stop = [] if self._spared else [(_request(Command.SET_AUTO_SYNC, on=0), STOPPED_S)]
                starts = [(_request(Command.MODULE_PROGRAM_END, to), 0.0) for to in others]
                end = (_request(Command.MODULE_PROGRAM_END, last), STARTED_S)
                return [*stop, *starts, end, (find, 0.0)]
            case RoundStep.STREAM:
                return self._stream()
        return []

    def _stream(self) -> list[Asked]:
        """Versions, which are asked once of each hub, period, and auto sync on."""
        hubs = self._startable()
        new = [ihb for ihb in hubs if ihb not in self._versions]
        self._versions |= {ihb: {} for ihb in new}
        if not self._spared and self._found <= set(hubs):
            hubs, new = [BROADCAST], [BROADCAST] * bool(new)
        versions = [(_request(command, to), VERSION_S) for to in new for command in VERSIONS]
        period = [
            _request(Command.SET_AUTO_SYNC_PERIOD, to, period_ms=self._period_ms) for to in hubs
        ]
        start = [_request(Command.SET_AUTO_SYNC, to, on=1) for to in hubs]
        return [*versions, *((request, 0.0) for request in (*period, *start))]

    def _name(self, packet: Packet) -> None:
        """Give a short id to a hub that answered discovery."""
        fields = commands.parse_answer(packet.command, packet.payload)
        if fields is None:  # a request from another host
            return
        uid = fields["uid"]
        if uid not in self._short_ids and len(self._short_ids) >= SHORT_IDS:
            return  # no id is left for this hub
        short_id = self._short_ids.setdefault(uid, len(self._short_ids) + 1)
        self._found.add(short_id)
        self._answered.add(short_id)
        if packet.ihb != short_id:
            self._misnamed |= {packet.ihb, short_id}
        else:
            self._is_named(short_id)
            if short_id in self._spared or self._step in (RoundStep.REST, RoundStep.STREAM):
                return
        self._unsure.add(short_id)
        self._queue.append((_request(Command.DISCOVERY_RECV_ID, uid=uid, short_id=short_id), 0.0))

    def _is_named(self, short_id: int) -> None:
        """A hub has its id. Once all have theirs, tables declared under ids that changed hands are
        dropped with the packets then on their way, and asked for anew."""
        self._unsure.discard(short_id)
        if self._unsure or not self._misnamed:
            return
        for ihb in self._misnamed:
            self._decoder.forget(ihb)
            self._scan_s.pop(ihb, None)
            self._late.pop(ihb, None)
        self._renamed |= not self._misnamed.isdisjoint(self._spared)
        self._misnamed = set()
        if self._step in (RoundStep.ASK, RoundStep.ASK_AGAIN):
            self._step = RoundStep(self._step - 1)
            self._answered |= self._found
        elif self._step in (RoundStep.REST, RoundStep.STREAM):
            self._begin()

    def _heed(self, packet: Packet) -> None:
        """A hub could not do what it was asked: where it cannot do it yet, it is asked again."""
        fields = commands.parse_answer(packet.command, packet.payload)
        if fields is None or fields["error"] not in (ErrorCode.BUSY, ErrorCode.PHASE):
            return
        ihb, failed = packet.ihb, fields["failed"]
        again: dict[Asked, None] = {
            ((ihb, failed, payload), pause_s): None
            for (to, command, payload), pause_s in self._sent
            if command == failed and to in (ihb, BROADCAST)
        }
        # versions are asked once: a hub that cannot tell them yet is started without
        is_new = again.keys() - self._queue and failed not in VERSIONS
        if not is_new or self._now_s > self._step_s + BUSY_MOST_S:
            return
        why = f"{ErrorCode(fields['error']).name} to {Command(failed).name}"
        self._is_late(ihb, f"still answers {why}: switch it off and on")
        self._queue.extendleft(reversed(again))
        self._free_s = self._now_s + BUSY_S
        self._until_s += BUSY_S + sum(pause_s for _, pause_s in again)

    def _note_bootloader(self, packet: Packet) -> None:
        if not is_of_bootloader(packet.command, packet.payload):
            self._late.pop(packet.ihb, None)
            return
        if packet.ihb not in self._late:
            log.info("hub %d %s", packet.ihb, COLD)
        self._is_late(packet.ihb, STUCK)

    def _is_late(self, ihb: int, why: str) -> None:
        since_s, _ = self._late.get(ihb, (self._now_s, ""))
        self._late[ihb] = since_s, f"hub {ihb} {why}"

    def _stuck(self) -> str:
        """A line on a hub that does not start; empty without one."""
        long_ago_s = self._now_s - STUCK_S
        return next((line for since_s, line in self._late.values() if since_s <= long_ago_s), "")


def _request(command: Command, to: int = BROADCAST, **fields: int) -> Request:
    return to, command, commands.request(command, **fields)


def _text(payload: bytes) -> str:
    text = payload.split(b"\0")[0][:VERSION_CHARACTERS]
    return "".join(chr(c) if 0x20 <= c < 0x7F else "?" for c in text).strip()
