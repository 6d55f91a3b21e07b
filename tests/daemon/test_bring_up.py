"""Bring-up against the virtual hub, on a fake clock."""

import itertools
import random
from collections import defaultdict
from collections.abc import Iterable
from typing import Any

import pytest

from taxeld.source.bring_up import SHORT_IDS, BringUp
from taxeld_protocol import commands, cyskin
from taxeld_protocol.cyskin import BROADCAST, LEAVE_BOOTLOADER, Command, Packet
from taxeld_protocol.decoder import Decoder
from taxeld_protocol.modules import Module, listed, wired
from taxeld_protocol.virtual_ihb import Answer, Phase, VirtualIhb
from tests.rig.virtual_hub import StuckHub

UIDS = [i // 10 + 1 << 4 | i % 10 + 1 for i in range(30)]


class Bus:
    """Hubs and a host that talk without delay, or with a tick of it; time is what `run` says."""

    def __init__(
        self,
        *hubs: VirtualIhb,
        late: bool = False,
        period_ms: int = 20,
        lost: float = 0.0,
        suis: Iterable[int] = (),
    ) -> None:
        """`lost`: the share of packets that do not arrive; `suis`: modules of the layout."""
        self.hubs = list(hubs)
        self.late = late
        self.lost, self._rng = lost, random.Random(0)
        self._marked: dict[int, VirtualIhb] = {}  # what a hub's channels read → the hub
        self._under_way: list[tuple[int, Answer]] = []
        self.walked: list[tuple[tuple[int, ...], tuple[int, ...]]] = []  # SUIs: own, of the table
        self.decoder = Decoder()
        self.bring_up = BringUp(self.decoder, period_ms, suis)
        self.news: list[str] = []
        self.scans = 0
        self.sent: list[int] = []
        self.said: list[tuple[float, int, int]] = []  # time, to whom, command
        self.scans_s: dict[int, list[float]] = defaultdict(list)  # hub UID → times of its scans

    def run(self, start: float, stop: float) -> None:
        now = start
        while now < stop:
            arrived, self._under_way = self._under_way, []
            for ihb, answer in arrived:
                self._take(ihb, answer, now)
            for request in self.bring_up.due(now):
                self._ask(*request, now)
            self.news += self.bring_up.news()
            for hub in self.hubs:
                if hub.due(now):
                    channels = sum(module.channels for module in hub.modules)
                    self._marked[hub.uid & 0xFFFF] = hub
                    for answer in hub.sensor_data([hub.uid & 0xFFFF] * channels):
                        self._hear(hub.short_id, answer, now)
            now = round(now + 0.01, 6)

    def _ask(self, to: int, command: int, payload: bytes, now: float) -> None:
        self.sent.append(command)
        self.said.append((now, to, command))
        packet = Packet(now, to, command, payload)
        for hub in self.hubs:
            if self._rng.random() < self.lost:
                continue
            for answer in hub.answer(packet):
                self._hear(hub.short_id, answer, now)

    def _hear(self, ihb: int, answer: Answer, now: float) -> None:
        if self._rng.random() < self.lost:
            return
        if self.late:
            self._under_way.append((ihb, answer))
        else:
            self._take(ihb, answer, now)

    def _take(self, ihb: int, answer: Answer, now: float) -> None:
        for frame in cyskin.to_frames(*answer, ihb=ihb):
            packet, scans = self.decoder.feed(frame)
            self.scans += len(scans)
            for scan in scans:
                self.bring_up.on_scan(scan.ihb, now)
                hub = self._marked[scan.counts[0]]
                self.scans_s[hub.uid].append(now)
                own = hub.modules
                table = tuple(module.sui for module in scan.table)
                self.walked.append((tuple(module.sui for module in own), table))
            if packet:
                self.bring_up.on_packet(packet)


def pair(one: int = 1, two: int = 2) -> tuple[VirtualIhb, VirtualIhb]:
    """Two hubs of one module each, with these short ids."""
    first = VirtualIhb(wired(UIDS[:10]), uid=7, short_id=one)
    return first, VirtualIhb(wired(UIDS[10:20]), uid=8, short_id=two)


VENDORS_ORDER = [
    LEAVE_BOOTLOADER,
    Command.DISCOVERY_PING,
    Command.DISCOVERY_RECV_ID,
    Command.DECLARE,
    Command.MODULE_DETAILS,
    Command.SET_AUTO_SYNC,
    Command.MODULE_PROGRAM_END,
    Command.DISCOVERY_PING,
    Command.DISCOVERY_RECV_ID,
    Command.DECLARE,
    Command.MODULE_DETAILS,
    Command.VERSION,
    Command.MODULE_BTLDR_VERSION,
    Command.MODULE_APP_VERSION,
    Command.SET_AUTO_SYNC_PERIOD,
    Command.SET_AUTO_SYNC,
]


@pytest.mark.parametrize(
    ("phase", "streams"), [*((phase, False) for phase in Phase), (Phase.RUNNING, True)]
)
@pytest.mark.parametrize("late", [False, True])
def test_a_hub_is_found_asked_and_started_in_the_vendors_order(
    phase: Phase, streams: bool, late: bool
) -> None:
    hub = VirtualIhb(wired(UIDS), phase=phase)
    hub.auto_sync = streams
    bus = Bus(hub, late=late)
    bus.run(0.0, 2.0)
    assert hub.auto_sync
    assert hub.period_ms == 20
    assert bus.decoder.table(1).modules == hub.modules
    assert bus.scans > 55
    assert bus.sent == VENDORS_ORDER


def test_the_vendors_pauses_follow_the_requests_that_need_them() -> None:
    bus = Bus(VirtualIhb(wired(UIDS)))
    bus.run(0.0, 2.0)
    times = [t for t, _, _ in bus.said]
    for at, pause_s in ((0, 0.1), (5, 0.06), (6, 0.5)):
        assert pause_s <= round(times[at + 1] - times[at], 6) < pause_s + 0.02


# how each hub is made, and the times when it gets power; in between it has none
HABITS: dict[str, tuple[dict[str, Any], list[float]]] = {
    "runs already": ({"phase": Phase.RUNNING}, [0.0]),
    "drops requests for 60 ms": ({"deaf_s": 0.06}, [0.0]),
    "is busy for 60 ms": ({"deaf_s": 0.06, "says_busy": True}, [0.0]),
    "is busy for 300 ms": ({"deaf_s": 0.3, "says_busy": True}, [0.0]),
    "modules take 1.2 s": ({"modules_s": 1.2}, [0.0]),
    "modules take 3 s": ({"modules_s": 3.0}, [0.0]),
    "modules take 7 s": ({"modules_s": 7.0}, [0.0]),
    "comes 5 s late": ({}, [5.0]),
    "comes after a long time": ({}, [33.3]),
    "comes late, modules take 1 s": ({"modules_s": 1.0}, [7.7]),
    "is switched off and on": ({}, [0.0, 8.0]),
    "is switched off and on twice": ({"modules_s": 0.5}, [0.0, 8.0, 21.0]),
}


@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize(
    ("beside", "short_id"),
    [(False, 1), (True, 9), (True, 1)],
    ids=["alone", "beside another", "beside another whose id it has"],
)
@pytest.mark.parametrize(("options", "powered"), HABITS.values(), ids=HABITS.keys())
def test_each_hub_streams_six_seconds_after_it_can_and_one_that_streams_is_left_alone(
    options: dict[str, Any], powered: list[float], beside: bool, short_id: int, late: bool
) -> None:
    modules = wired(UIDS)
    other = VirtualIhb(modules[:1], uid=7, short_id=1)
    hub = VirtualIhb(modules[1:], uid=8, short_id=short_id, **options)
    bus = Bus(*[other] * beside, late=late, suis=[m.sui for m in modules if m.sui])
    now = 0.0
    for at in powered:
        bus.run(now, at)
        if hub not in bus.hubs:
            bus.hubs.append(hub)
        bus.run(at, at + 12.5)
        started = [t for t, _, command in bus.said if command == Command.MODULE_PROGRAM_END]
        can_s = min(t for t in started if t >= at) + options.get("modules_s", 0.0)
        assert min(t for t in bus.scans_s[8] if t >= at) <= max(at + 6.0, can_s + 6.0)
        assert bus.scans_s[8][-1] > at + 12.4
        hub.reboot()
        bus.hubs.remove(hub)
        now = at + 12.5
    if beside:
        gaps = [b - a for a, b in itertools.pairwise(bus.scans_s[7])]
        assert max(gaps) < 0.1
        [begin, *_] = bus.scans_s[7]
        heard = {command for t, to, command in bus.said if t > begin and to in (1, BROADCAST)}
        if short_id == 1:  # what was declared under its id may be the other hub's
            heard -= {Command.DECLARE, Command.MODULE_DETAILS}
        assert heard <= {LEAVE_BOOTLOADER, Command.DISCOVERY_PING, Command.DISCOVERY_RECV_ID}


@pytest.mark.parametrize("late", [False, True])
def test_while_modules_of_the_layout_are_on_no_hub_others_are_looked_for_now_and_then(
    late: bool,
) -> None:
    modules = wired(UIDS)
    bus = Bus(VirtualIhb(modules[1:]), late=late, suis=[m.sui for m in modules if m.sui])
    bus.run(0.0, 60.0)
    assert bus.sent == VENDORS_ORDER + [LEAVE_BOOTLOADER, Command.DISCOVERY_PING] * 12


def test_a_hub_that_stays_busy_is_asked_at_a_low_rate_and_told_of() -> None:
    hub = VirtualIhb(wired(UIDS), deaf_s=1e9, says_busy=True)
    bus = Bus(hub)
    bus.run(0.0, 60.0)
    assert len(bus.sent) < 60 * 8
    assert bus.bring_up.waits_for.startswith("hub 1 still answers BUSY to ")


VERSIONS_LINE = "hub 1: version virtual 1, bootloader virtual 2, application virtual 3"


@pytest.mark.parametrize(
    ("versions", "line"),
    [
        ({}, ""),
        ({Command.VERSION: "2.1\0\xff"}, "version 2.1"),
        ({Command.MODULE_APP_VERSION: "\x1b[2J" + 99 * "é"}, "application ?[2J" + 28 * "?"),
    ],
)
def test_each_hub_is_asked_once_for_its_versions_and_what_it_says_is_told(
    versions: dict[int, str], line: str
) -> None:
    one, two = (
        VirtualIhb(wired(UIDS[:10]), uid=7),
        VirtualIhb(wired(UIDS[10:]), uid=8, versions=versions),
    )
    bus = Bus(one, two)
    bus.run(0.0, 3.0)
    two.reboot()
    bus.run(3.0, 20.0)
    for command in (Command.VERSION, Command.MODULE_BTLDR_VERSION, Command.MODULE_APP_VERSION):
        assert bus.sent.count(command) == 1
    told = {"1": VERSIONS_LINE.removeprefix("hub 1: ")} | ({"2": line} if line else {})
    assert bus.bring_up.firmware == told
    assert [news for news in bus.news if "version" in news or "application" in news] == [
        f"hub {ihb}: {text}" for ihb, text in told.items()
    ]


@pytest.mark.parametrize(
    ("module", "declares", "reason"),
    [
        (Module(12, 9, 0xFFF, grouping=2), 12, "module 9 is grouped (grouping 2)"),
        (Module(12, 9, 0xFFF), 3, "module 9 declares 3 channels, but its mask 0xfff has 12"),
    ],
)
def test_a_hub_with_a_module_that_cannot_be_read_is_refused_and_the_others_stream(
    module: Module, declares: int, reason: str
) -> None:
    class Odd(VirtualIhb):
        def answer(self, packet: Packet) -> list[Answer]:
            answers = super().answer(packet)
            if packet.command == Command.DECLARE and self.phase == Phase.RUNNING:
                return [(Command.DECLARE, bytes((1, 0, declares)))]
            return answers

    odd, good = Odd([module], uid=7), VirtualIhb(wired(UIDS), uid=8)
    bus = Bus(odd, good)
    bus.run(0.0, 20.0)
    assert bus.bring_up.waits_for.startswith(f"hub 1 is refused: {reason}")
    assert not odd.auto_sync
    assert bus.scans_s.keys() == {8}
    bus = Bus(odd)
    odd.reboot()
    bus.run(0.0, 60.0)
    assert len(bus.sent) < 12 * len(VENDORS_ORDER)
    bus.hubs = [VirtualIhb(listed([(9, 0xFFF)]), uid=7)]
    bus.run(60.0, 67.0)
    assert bus.bring_up.waits_for == ""
    assert bus.scans > 0


def test_a_hub_in_its_bootloader_is_told_of_once_and_waited_for_where_it_stays() -> None:
    stuck, good = StuckHub(wired(UIDS), uid=7), VirtualIhb(wired(UIDS), uid=8)
    bus = Bus(stuck)
    bus.run(0.0, 5.0)
    assert bus.news == ["hub 1 is in its bootloader, as after power-on; it is started"]
    assert bus.bring_up.waits_for == ""
    bus.run(5.0, 60.0)
    assert len(bus.news) == 1
    assert bus.bring_up.waits_for.startswith("hub 1 stays in its bootloader: switch it off and on")
    bus.hubs = [VirtualIhb(wired(UIDS), uid=7)]
    bus.run(60.0, 63.0)
    assert bus.bring_up.waits_for == ""
    bus = Bus(good)
    bus.run(0.0, 60.0)
    assert bus.news[1:] == [VERSIONS_LINE]
    assert bus.decoder.counters.bootloader == 1 + len(wired(UIDS))


def test_a_hub_whose_modules_do_not_answer_does_not_keep_another_from_streaming() -> None:
    class Broken(VirtualIhb):
        def answer(self, packet: Packet) -> list[Answer]:
            asked = packet.command == Command.MODULE_DETAILS
            return [] if asked else super().answer(packet)

    bus = Bus(Broken(wired(UIDS[:10]), uid=7), VirtualIhb(wired(UIDS[10:20]), uid=8))
    bus.run(0.0, 3.0)
    before = bus.scans
    bus.run(3.0, 13.0)
    assert bus.scans - before > 480


def test_a_hub_that_speaks_is_not_stopped_while_another_is_brought_up() -> None:
    one, two = pair()
    bus = Bus(one, two)
    bus.run(0.0, 2.0)
    stops = bus.sent.count(Command.SET_AUTO_SYNC)
    two.reboot()
    assert two.phase == Phase.BOOTLOADER
    bus.run(2.0, 5.0)
    assert two.auto_sync
    assert bus.sent.count(Command.SET_AUTO_SYNC) == stops + 1


def test_a_period_longer_than_the_silence_that_is_asked_at_is_waited_for() -> None:
    bus = Bus(VirtualIhb(wired(UIDS)), period_ms=4000)
    bus.run(0.0, 30.0)
    assert bus.sent == VENDORS_ORDER
    assert bus.scans == 8


@pytest.mark.parametrize("late", [False, True])
def test_packets_that_are_lost_are_asked_for_again(late: bool) -> None:
    one, two = pair(9, 9)
    bus = Bus(one, two, late=late, period_ms=50, lost=0.2)  # the hubs begin with that period
    bus.run(0.0, 60.0)
    bus.lost = 0.0
    bus.run(60.0, 66.0)
    before = bus.scans
    bus.run(66.0, 76.0)
    assert (one.short_id, two.short_id) == (1, 2)
    assert bus.scans - before > 2 * 190
    assert [own for own, table in bus.walked if own != table] == []


def test_the_tables_of_hubs_that_exchanged_their_ids_are_told_from_each_other() -> None:
    """Who keeps by the version what a table led to must not take one for the other."""
    bus = Bus()
    table = {}
    for hub in (VirtualIhb(wired(UIDS[:10])), VirtualIhb(wired(UIDS[10:20]))):
        hub.phase = Phase.RUNNING
        for command in (Command.DECLARE, Command.MODULE_DETAILS):
            fields = {"module": 255} if command == Command.MODULE_DETAILS else {}
            request = Packet(0.0, BROADCAST, command, commands.request(command, **fields))
            for answer in hub.answer(request):
                bus.decoder.on_packet(Packet(0.0, 1, *answer))
        table[bus.decoder.table(1).version] = bus.decoder.table(1).modules
        bus.decoder.forget(1)
    assert len(table) == 2


def test_once_scans_come_nothing_more_is_sent() -> None:
    bus = Bus(VirtualIhb(wired(UIDS)))
    bus.run(0.0, 2.0)
    sent = len(bus.sent)
    bus.run(2.0, 60.0)
    assert len(bus.sent) == sent


@pytest.mark.parametrize("late", [False, True])
def test_hubs_that_exchange_their_short_ids_keep_their_own_tables(late: bool) -> None:
    """What they declare under their old ids is on its way when they are given the new ones."""
    one, two = pair(2, 1)
    bus = Bus(one, two, late=late)
    bus.run(0.0, 5.0)
    assert (one.short_id, two.short_id) == (1, 2)
    assert bus.scans > 2 * 180
    assert [own for own, table in bus.walked if own != table] == []


def test_a_hub_that_reboots_while_another_speaks_is_started_again() -> None:
    one, two = pair()
    bus = Bus(one, two, late=True)
    bus.run(0.0, 3.0)
    two.reboot()
    bus.run(3.0, 6.0)
    assert two.auto_sync
    before = bus.scans
    bus.run(6.0, 7.0)
    assert bus.scans - before >= 2 * 45


def test_a_hub_that_is_gone_for_good_is_called_now_and_then_and_the_other_is_heard() -> None:
    one, two = pair()
    bus = Bus(one, two)
    bus.run(0.0, 3.0)
    bus.hubs.remove(two)
    sent, before = len(bus.sent), bus.scans
    bus.run(3.0, 33.0)
    assert len(bus.sent) - sent <= 12 * 7
    assert bus.scans - before >= 30 * 45


def test_hubs_that_all_fall_silent_are_asked_at_once_though_one_was_waited_for() -> None:
    gone, heard = VirtualIhb(wired(UIDS[:10]), uid=1), VirtualIhb(wired(UIDS[10:20]), uid=2)
    bus = Bus(gone, heard)
    bus.run(0.0, 3.0)
    bus.hubs.remove(gone)
    bus.run(3.0, 10.0)
    asked = len(bus.sent)
    at = 10.0
    while len(bus.sent) == asked:  # now the one that is gone is called, in vain
        bus.run(at, at + 0.1)
        at += 0.1
    bus.run(at, at + 1.0)
    heard.reboot()
    scans = bus.scans
    bus.run(at + 1.0, at + 4.0)
    assert bus.scans > scans


def test_a_hub_that_rebooted_is_started_again() -> None:
    hub = VirtualIhb(wired(UIDS))
    bus = Bus(hub)
    bus.run(0.0, 2.0)
    hub.auto_sync, hub.period_ms, hub.short_id = False, 50, 9
    bus.run(2.0, 5.0)
    assert hub.auto_sync
    assert (hub.short_id, hub.period_ms) == (1, 20)


def test_a_bus_that_makes_up_hubs_without_end_fills_no_table() -> None:
    bus = Bus(VirtualIhb(wired(UIDS)))
    bus.run(0.0, 2.0)
    named: set[bytes] = set()
    for uid in range(1000, 4000):
        answer = uid.to_bytes(4, "big")
        for ihb in (uid % 254 + 1, 9):
            bus.bring_up.on_packet(Packet(0.0, ihb, Command.DISCOVERY_PING, answer))
    named |= {payload for *_, payload in bus.bring_up.due(4.0)}
    assert 0 < len(named) < SHORT_IDS, "one id is the hub's that is there"
    scans = bus.scans
    bus.run(4.0, 9.0)
    assert bus.scans - scans > 100, "the hub that is there is still heard"


def test_silence_is_asked_at_a_steady_low_rate() -> None:
    bus = Bus()
    bus.run(0.0, 12.0)
    assert bus.sent == [LEAVE_BOOTLOADER, Command.DISCOVERY_PING] * 20
