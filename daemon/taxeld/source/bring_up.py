"""Bring-up of a CySkin bus, in the order of the vendor's own library and with its pauses.

Pure: packets and the time in, requests out. All of it is one round: out of the hubs' bootloader →
discovery and short ids → DECLARE and DETAILS → auto sync off, and the modules out of their
bootloader → discovery, DECLARE and DETAILS again → versions, asked once → period → auto sync on.
Rounds follow each other at doubling pauses while a hub or a module is missing, and at once when all
hubs fall silent.

A round is for the hubs that are silent: where discovery finds none, it ends. Its requests are
broadcast; while other hubs send, they go to each silent hub under its own id, so that they never
cut into the fragments that another is sending.
"""

import logging
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

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

RETRY_S = 0.5  # time for the answers to a step, and the first pause between rounds
PAUSE_MAX_S = 4.0  # longest pause between rounds: who switches a hub on sees it start
SILENCE_S = 1.0  # time without a scan after which a hub is silent
SILENT_PERIODS = 3  # or so many scan periods, if they are longer
STARTING_TRIES = 3  # tries to hear channels declared: modules take time to leave their bootloader
STUCK_S = 10.0  # time without a start after which a hub is reported: no module needs as long
SHORT_IDS = 254  # short ids that can be given
# The vendor's pauses: after a hub is led out of its bootloader, after auto sync is switched off,
# and after modules are led out of their bootloader.
LEFT_S, STOPPED_S, STARTED_S = 0.1, 0.06, 0.5
SETTLE_S = 0.1  # time in which all hubs answer discovery, as other hubs are sending
BUSY_S = 0.1  # pause before a step is made again that a hub could not take
BUSY_TRIES = 10  # times that it is made again
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


class RoundStep(NamedTuple):
    """Requests that go out together, and the wait that begins when they have left."""

    requests: Sequence[Request]
    least_s: float
    most_s: float
    is_done: Callable[[], bool] = lambda: False  # asked between the two


class BringUp:
    """Decides what to send to get scans and to keep them coming."""

    def __init__(self, decoder: Decoder, period_ms: int, suis: Iterable[int] = ()) -> None:
        """`suis`: serial numbers of the modules that are looked for until they are found."""
        self._decoder = decoder
        self._period_ms = period_ms
        self._patience_s = max(RETRY_S, SILENT_PERIODS * period_ms / 1000.0)
        self._suis = set(suis)
        self._lacking = self._suis  # serial numbers that no hub has declared
        self._scan_s: dict[int, float] = {}  # short id → time of its last scan
        self._short_ids: dict[int, int] = {}  # hub UID → its short id
        self._names: dict[int, Request] = {}  # short id → request that gives it, to be sent
        # short id that was given and is not acknowledged yet → ids that its hub had
        self._unsure: dict[int, set[int]] = {}
        self._versions: dict[int, dict[str, str]] = {}  # id of each hub that was asked → versions
        self._logged: set[int] = set()  # ids of the hubs whose versions the log has
        # id of a hub that does not start → since when, and a line on it
        self._late: dict[int, tuple[float, str]] = {}
        self._found: set[int] = set()  # ids of the hubs that discovery found in this round
        self._spared: set[int] = set()  # ids of the hubs that were sending then
        self._told: set[int] = set()  # ids of the hubs that answered DECLARE in this step
        self._speaking: set[int] = set()  # ids of the hubs that are sending
        self._now_s = -math.inf
        self._left_s = math.inf  # time when the requests of the step had left
        self._is_refused = False  # whether the step is to be made again
        self._tries = 0  # times that it may still be
        self._begin()

    @property
    def is_starting(self) -> bool:
        """Whether a hub has answered that may still be silent for a while."""
        return not self._found <= self._speaking

    @property
    def waits_for(self) -> str:
        """A line on missing answers without which not all scans come; or empty."""
        long_ago_s = self._now_s - STUCK_S
        stuck = (line for since_s, line in self._late.values() if since_s <= long_ago_s)
        return self._decoder.refusal or next(stuck, "")

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
            if is_of_bootloader(command, payload):
                self._is_late(ihb, STUCK, COLD)
            else:
                self._late.pop(ihb, None)

    def on_scan(self, ihb: int, now_s: float) -> None:
        if ihb not in self._logged and str(ihb) in self.firmware:
            self._logged.add(ihb)
            log.info("hub %d: %s", ihb, self.firmware[str(ihb)])
        self._scan_s[ihb] = now_s
        self._late.pop(ihb, None)

    def due(self, now_s: float) -> list[Request]:
        """The requests to send now. It is called again when all of them have left."""
        self._now_s = now_s
        silence_s, spoke = max(SILENCE_S, self._patience_s), self._speaking
        self._speaking = {ihb for ihb, t in self._scan_s.items() if now_s - t < silence_s}
        if spoke and not self._speaking:
            self._begin()
        self._left_s = min(self._left_s, now_s)
        requests = [*self._names.values()]
        self._names.clear()
        while not requests and self._is_over(now_s - self._left_s):
            if self._is_refused:
                self._tries, self._is_refused = self._tries - 1, False
            else:
                self._step, self._tries = next(self._steps), BUSY_TRIES
            requests += self._step.requests
            self._left_s = math.inf if requests else now_s
        return requests

    @staticmethod
    def stop() -> Request:
        return _request(Command.SET_AUTO_SYNC, on=0)

    def _begin(self) -> None:
        self._steps, self._step = self._rounds(), RoundStep((), 0.0, 0.0)
        self._left_s = math.inf
        self._is_refused = False

    def _is_over(self, waited_s: float) -> bool:
        """Whether the step is, or is to be made again."""
        _, least_s, most_s, is_done = self._step
        if self._is_refused:
            return waited_s >= BUSY_S
        return waited_s >= most_s or (waited_s >= least_s and is_done())

    def _rounds(self) -> Iterator[RoundStep]:
        pause_s, before = RETRY_S, None
        while True:
            yield from self._round()
            pause_s = min(2.0 * pause_s, PAUSE_MAX_S) if self._silent == before else RETRY_S
            before = self._silent
            tables = [t for ihb, t in self._decoder.tables.items() if ihb not in self._refused]
            self._lacking = self._suis - {m.sui for table in tables for m in table if m.channels}
            yield RoundStep((), 0.0, pause_s, self._is_well)
            yield RoundStep((), 0.0, math.inf, lambda: not self._is_well())

    def _round(self) -> Iterator[RoundStep]:
        self._found = set()
        yield RoundStep([(BROADCAST, LEAVE_BOOTLOADER, b"")], LEFT_S, LEFT_S)
        yield self._discovery()
        self._spared = self._speaking
        known = self._spared & self._decoder.tables.keys()
        if self._found <= known:
            return
        yield self._ask(self._found - known, lambda ihb: ihb in self._told)
        if not self._silent:  # a hub that sends was to tell its modules anew
            return
        yield RoundStep(self._to(self._silent, Command.SET_AUTO_SYNC, on=0), STOPPED_S, STOPPED_S)
        yield RoundStep(self._to(self._silent, Command.MODULE_PROGRAM_END), STARTED_S, STARTED_S)
        yield self._discovery()
        for _ in range(STARTING_TRIES):
            yield self._ask(self._silent, self._is_known)
            if all(map(self._is_known, self._silent | self._told)):
                break
        yield from self._stream()

    def _stream(self) -> Iterator[RoundStep]:
        """Versions, which are asked once of each hub, period, and auto sync on."""
        hubs = set(filter(self._is_known, self._told - self._spared - self._refused))
        if not hubs:
            return  # they are asked again in the next round
        new = hubs - self._versions.keys()
        self._versions |= {ihb: {} for ihb in new}
        for command in VERSIONS if new else ():
            yield RoundStep(self._to(new, command), VERSION_S, VERSION_S)
        period = self._to(hubs, Command.SET_AUTO_SYNC_PERIOD, period_ms=self._period_ms)
        start = self._to(hubs, Command.SET_AUTO_SYNC, on=1)
        yield RoundStep([*period, *start], 0.0, self._patience_s, lambda: hubs <= self._speaking)

    def _discovery(self) -> RoundStep:
        """… until all hubs that answer have their short ids."""

        def is_done() -> bool:
            return bool(self._found) and not self._unsure.keys() & self._found

        return RoundStep([_request(Command.DISCOVERY_PING)], SETTLE_S, RETRY_S, is_done)

    def _ask(self, hubs: set[int], is_done: Callable[[int], bool]) -> RoundStep:
        """DECLARE and DETAILS, until it `is_done` for each hub, and for others that answer."""
        self._told = set()
        requests = [
            *self._to(hubs, Command.DECLARE),
            *self._to(hubs, Command.MODULE_DETAILS, module=ALL_MODULES),
        ]
        return RoundStep(requests, 0.0, RETRY_S, lambda: all(map(is_done, hubs | self._told)))

    def _to(self, hubs: set[int], command: Command, **fields: int) -> list[Request]:
        """A request to these hubs."""
        is_to_all = not self._spared and self._silent <= hubs
        ids = [BROADCAST] if is_to_all else sorted(hubs)
        return [_request(command, to, **fields) for to in ids]

    @property
    def _silent(self) -> set[int]:
        """Hubs that discovery found, and that were not sending then."""
        return self._found - self._spared

    @property
    def _refused(self) -> set[int]:
        """Hubs that are not started, as their modules cannot be read."""
        return {ihb for ihb, hub in self._decoder.hubs.items() if hub.table.fault}

    def _is_well(self) -> bool:
        """Whether all hubs that were ever heard are sending, and all modules are on them."""
        wanted = {*self._scan_s, *self._short_ids.values()} - self._refused
        return bool(self._speaking) and self._speaking >= wanted and not self._lacking

    def _is_known(self, ihb: int) -> bool:
        """Whether a hub has declared its channels in this step, and the modules they belong to. Of
        hubs that may share an id none is known."""
        unsure = self._found & self._unsure.keys()
        shared = {i for found in unsure for i in (found, *self._unsure[found])}
        table = self._decoder.table(ihb)
        return ihb in self._told - shared and table.complete and not table.in_bootloader

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
        self._names[short_id] = _request(Command.DISCOVERY_RECV_ID, uid=uid, short_id=short_id)
        if packet.ihb == short_id:
            self._is_named(short_id)
        else:
            self._unsure.setdefault(short_id, set()).add(packet.ihb)

    def _is_named(self, short_id: int) -> None:
        """A hub has its id. What was declared under this one and those that it had may be another
        hub's: with the packets then on their way it is dropped, and asked for anew."""
        had = self._unsure.pop(short_id, set())
        for ihb in (short_id, *had) if had else ():
            self._decoder.forget(ihb)
            self._told.discard(ihb)
            self._late.pop(ihb, None)
            if ihb == short_id or ihb not in self._short_ids.values():
                self._scan_s.pop(ihb, None)

    def _heed(self, packet: Packet) -> None:
        """A hub could not do what it was asked: where it cannot do it yet, it is asked again."""
        fields = commands.parse_answer(packet.command, packet.payload)
        if fields is None or fields["error"] not in (ErrorCode.BUSY, ErrorCode.PHASE):
            return
        failed = fields["failed"]
        # versions are asked once: a hub that cannot tell them yet is started without
        if failed in VERSIONS or not any(failed == asked for _, asked, _ in self._step.requests):
            return
        why = f"{ErrorCode(fields['error']).name} to {Command(failed).name}"
        self._is_late(packet.ihb, f"still answers {why}: switch it off and on")
        self._is_refused = self._tries > 0

    def _is_late(self, ihb: int, why: str, news: str = "") -> None:
        """A hub does not start; why, and the news where it is the first that is heard of it."""
        if news and ihb not in self._late:
            log.info("hub %d %s", ihb, news)
        since_s, _ = self._late.get(ihb, (self._now_s, ""))
        self._late[ihb] = since_s, f"hub {ihb} {why}"


def _request(command: Command, to: int = BROADCAST, **fields: int) -> Request:
    return to, command, commands.request(command, **fields)


def _text(payload: bytes) -> str:
    text = payload.split(b"\0")[0][:VERSION_CHARACTERS]
    return "".join(chr(c) if 0x20 <= c < 0x7F else "?" for c in text).strip()
