"""Bring-up against the virtual hub, on a fake clock."""

import random

import pytest

from taxeld.source.bring_up import SHORT_IDS, STARTING_TRIES, BringUp, Request
from taxeld_protocol import commands, cyskin
from taxeld_protocol.cyskin import BROADCAST, LEAVE_BOOTLOADER, Command, Packet
from taxeld_protocol.decoder import Decoder
from taxeld_protocol.modules import wired
from taxeld_protocol.virtual_ihb import Answer, Phase, VirtualIhb
from tests.rig.virtual_hub import StuckHub

UIDS = [i // 10 + 1 << 4 | i % 10 + 1 for i in range(30)]


class Bus:
    """Hubs and a host that talk without delay, or with a tick of it; time is what `run` says."""

    def __init__(
        self, *hubs: VirtualIhb, late: bool = False, period_ms: int = 20, lost: float = 0.0
    ) -> None:
        """`lost`: the share of packets that do not arrive."""
        self.hubs = list(hubs)
        self.late = late
        self.lost, self._rng = lost, random.Random(0)
        self._under_way: list[tuple[int, Request]] = []
        self.walked: list[tuple[tuple[int, ...], tuple[int, ...]]] = []  # SUIs: own, of the table
        self.decoder = Decoder()
        self.bring_up = BringUp(self.decoder, period_ms)
        self.news: list[str] = []
        self.scans = 0
        self.sent: list[int] = []

    def run(self, start: float, stop: float) -> None:
        now = start
        while now < stop:
            arrived, self._under_way = self._under_way, []
            for ihb, answer in arrived:
                self._take(ihb, answer, now)
            for request in self.bring_up.due(now):
                self._ask(*request)
            self.news += self.bring_up.news()
            for hub in self.hubs:
                if hub.due(now):
                    channels = sum(module.channels for module in hub.modules)
                    for answer in hub.sensor_data([self.hubs.index(hub)] * channels):
                        self._hear(hub.short_id, answer, now)
            now = round(now + 0.01, 6)

    def _ask(self, command: int, payload: bytes) -> None:
        self.sent.append(command)
        packet = cyskin.Packet(0.0, BROADCAST, command, payload)
        for hub in self.hubs:
            if self._rng.random() < self.lost:
                continue
            for answer in hub.answer(packet):
                self._hear(hub.short_id, answer, 0.0)

    def _hear(self, ihb: int, answer: Request, now: float) -> None:
        if self._rng.random() < self.lost:
            return
        if self.late:
            self._under_way.append((ihb, answer))
        else:
            self._take(ihb, answer, now)

    def _take(self, ihb: int, answer: Request, now: float) -> None:
        for frame in cyskin.to_frames(*answer, ihb=ihb):
            packet, scans = self.decoder.feed(frame)
            self.scans += len(scans)
            for scan in scans:
                self.bring_up.on_scan(scan.ihb, now)
                own = self.hubs[scan.counts[0]].modules
                table = tuple(module.sui for module in scan.table)
                self.walked.append((tuple(module.sui for module in own), table))
            if packet:
                for request in self.bring_up.on_packet(packet):
                    self._ask(*request)


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
    assert bus.scans > 80
    assert bus.sent == VENDORS_ORDER


class SlowHub(VirtualIhb):
    """Its modules take some requests for DECLARE to leave their bootloader."""

    left = 0

    def answer(self, packet: Packet) -> list[Answer]:
        if packet.command == Command.MODULE_PROGRAM_END:
            if self.phase == Phase.MODULES and not self.left:
                self.left = STARTING_TRIES
            return []
        if packet.command == Command.DECLARE and self.left:
            self.left -= 1
            if not self.left:
                self.phase = Phase.RUNNING
        return super().answer(packet)


def test_modules_may_take_their_time_to_start() -> None:
    hub = SlowHub(wired(UIDS))
    bus = Bus(hub)
    bus.run(0.0, 3.0)
    assert bus.sent.count(Command.MODULE_PROGRAM_END) == 1
    assert bus.decoder.table(1).modules == hub.modules
    assert bus.scans > 50


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
    assert len(bus.news) == 1
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
    bus = Bus(one, two, late=late, lost=0.2)
    bus.run(0.0, 60.0)
    bus.lost, before = 0.0, bus.scans
    bus.run(60.0, 70.0)
    assert (one.short_id, two.short_id) == (1, 2)
    assert bus.scans - before > 2 * 480
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
    named = set()
    for uid in range(1000, 4000):
        answer = uid.to_bytes(4, "big")
        for ihb in (uid % 254 + 1, 9):
            named |= set(
                bus.bring_up.on_packet(cyskin.Packet(0.0, ihb, Command.DISCOVERY_PING, answer))
            )
    assert 0 < len(named) < SHORT_IDS, "one id is the hub's that is there"
    scans = bus.scans
    bus.run(4.0, 9.0)
    assert bus.scans - scans > 100, "the hub that is there is still heard"


def test_silence_is_asked_at_a_steady_low_rate() -> None:
    bus = Bus()
    bus.run(0.0, 10.0)
    assert bus.sent == [LEAVE_BOOTLOADER, Command.DISCOVERY_PING] * 20
