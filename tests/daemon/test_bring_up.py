"""Bring-up against virtual hubs, on a fake clock."""

import itertools
import logging
import random
from collections import defaultdict
from collections.abc import Iterable
from typing import Any

import pytest

from taxeld.source.bring_up import SHORT_IDS, BringUp
from taxeld_hil.rig.virtual_ihb import Answer, Phase, VirtualIhb
from taxeld_protocol import cyskin
from taxeld_protocol.cyskin import BROADCAST, LEAVE_BOOTLOADER, Command, ErrorCode, Packet
from taxeld_protocol.decoder import Decoder
from taxeld_protocol.modules import Module, listed, wired
from tests.rig.virtual_hub import LateHub, StuckHub, told

UIDS = [i // 10 + 1 << 4 | i % 10 + 1 for i in range(30)]
MODULES = wired(UIDS)
PING = [LEAVE_BOOTLOADER, Command.DISCOVERY_PING]
ASK = [Command.DECLARE, Command.MODULE_DETAILS]
VENDORS_ORDER = [
    *(*PING, Command.DISCOVERY_RECV_ID, *ASK),
    *(Command.SET_AUTO_SYNC, Command.MODULE_PROGRAM_END),
    *(Command.DISCOVERY_PING, Command.DISCOVERY_RECV_ID, *ASK),
    *(Command.VERSION, Command.MODULE_BTLDR_VERSION, Command.MODULE_APP_VERSION),
    *(Command.SET_AUTO_SYNC_PERIOD, Command.SET_AUTO_SYNC),
]
VERSIONS_LINE = "hub 1: version virtual 1, bootloader virtual 2, application virtual 3"


class HubBus:
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
        self.hubs, self.late = list(hubs), late
        self.lost, self._rng = lost, random.Random(0)
        self._marked: dict[int, VirtualIhb] = {}  # what a hub's channels read → the hub
        self._under_way: list[tuple[int, Answer]] = []
        self.wrong = 0  # scans that were read by another hub's table
        self.decoder = Decoder()
        self.bring_up = BringUp(self.decoder, period_ms, suis)
        self.said: list[tuple[float, int, int]] = []  # time, to whom, command
        self.scans_s: dict[int, list[float]] = defaultdict(list)  # hub UID → times of its scans

    @property
    def sent(self) -> list[int]:
        return [command for _, _, command in self.said]

    @property
    def scans(self) -> int:
        return sum(map(len, self.scans_s.values()))

    def run(self, start: float, stop: float) -> None:
        now = start
        while now < stop:
            arrived, self._under_way = self._under_way, []
            for ihb, answer in arrived:
                self._take(ihb, answer, now)
            for to, command, payload in self.bring_up.due(now):
                self.said.append((now, to, command))
                for hub in self.hubs:
                    if self._rng.random() >= self.lost:
                        for answer in hub.answer(Packet(now, to, command, payload)):
                            self._hear(hub.short_id, answer, now)
            for hub in self.hubs:
                if hub.due(now):
                    channels = sum(module.channels for module in hub.modules)
                    self._marked[hub.uid & 0xFFFF] = hub
                    for answer in hub.sensor_data([hub.uid & 0xFFFF] * channels):
                        self._hear(hub.short_id, answer, now)
            now = round(now + 0.01, 6)

    def _hear(self, ihb: int, answer: Answer, now: float) -> None:
        if self._rng.random() < self.lost:
            return
        if self.late:
            self._under_way.append((ihb, answer))
        else:
            self._take(ihb, answer, now)

    def _take(self, ihb: int, answer: Answer, now: float) -> None:
        frames = cyskin.to_frames(*answer, ihb=ihb)
        for packet, scans in self.decoder.take(frames):
            for scan in scans:
                self.bring_up.on_scan(scan.ihb, now)
                hub = self._marked[scan.counts[0]]
                self.scans_s[hub.uid].append(now)
                self.wrong += [m.sui for m in hub.modules] != [m.sui for m in scan.table]
            self.bring_up.on_packet(packet)


def pair(one: int = 1, two: int = 2) -> tuple[VirtualIhb, VirtualIhb]:
    """Two hubs of one module each, with these short ids."""
    first = VirtualIhb(MODULES[:1], uid=7, short_id=one)
    return first, VirtualIhb(MODULES[1:2], uid=8, short_id=two)


lates = pytest.mark.parametrize("late", [False, True])


@pytest.mark.parametrize(
    ("phase", "streams"), [*((phase, False) for phase in Phase), (Phase.RUNNING, True)]
)
@lates
def test_a_hub_is_found_asked_and_started_in_the_vendors_order_and_then_left_alone(
    phase: Phase, streams: bool, late: bool
) -> None:
    hub = VirtualIhb(MODULES, phase=phase)
    hub.auto_sync = streams
    bus = HubBus(hub, late=late)
    bus.run(0.0, 30.0)
    assert hub.auto_sync
    assert hub.period_ms == 20
    assert bus.decoder.table(1).modules == hub.modules
    assert bus.scans > 1400
    assert bus.sent == VENDORS_ORDER
    times = [t for t, _, _ in bus.said]
    for at, pause_s in ((0, 0.1), (5, 0.06), (6, 0.5)):  # as the vendor's library has them
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
    "is switched off and on twice": ({"modules_s": 0.5}, [0.0, 8.0, 21.0]),
}


@lates
@pytest.mark.parametrize(
    ("beside", "short_id"),
    [(False, 1), (True, 9), (True, 1)],
    ids=["alone", "beside another", "beside another whose id it has"],
)
@pytest.mark.parametrize(("options", "powered"), HABITS.values(), ids=HABITS.keys())
def test_each_hub_streams_six_seconds_after_it_can_and_one_that_streams_is_left_alone(
    options: dict[str, Any], powered: list[float], beside: bool, short_id: int, late: bool
) -> None:
    other = VirtualIhb(MODULES[:1], uid=7, short_id=1)
    hub = LateHub(MODULES[1:], uid=8, short_id=short_id, **options)
    bus = HubBus(*[other] * beside, late=late, suis=[m.sui for m in MODULES if m.sui])
    now = 0.0
    for at in powered:
        bus.run(now, at)
        bus.hubs.append(hub)
        bus.run(at, at + 12.5)
        started = [t for t, _, command in bus.said if command == Command.MODULE_PROGRAM_END]
        can_s = min(t for t in started if t >= at) + options.get("modules_s", 0.0)
        assert min(t for t in bus.scans_s[8] if t >= at) <= max(at + 6.0, can_s + 6.0)
        assert bus.scans_s[8][-1] > at + 12.4
        hub.reboot()
        bus.hubs.remove(hub)
        now = at + 12.5
    assert bus.wrong == 0
    if beside:
        assert max(b - a for a, b in itertools.pairwise(bus.scans_s[7])) < 0.1
        [begin, *_] = bus.scans_s[7]
        heard = {command for t, to, command in bus.said if t > begin and to in (1, BROADCAST)}
        if short_id == 1:  # what was declared under its id may be the other hub's
            heard -= {*ASK}
        assert heard <= {*PING, Command.DISCOVERY_RECV_ID}


class MuteHub(VirtualIhb):
    """Its modules do not answer, or it says that it cannot ask them."""

    says: tuple[Answer, ...] = ()

    def answer(self, packet: Packet) -> list[Answer]:
        is_asked = packet.command == Command.MODULE_DETAILS
        return [*self.says] if is_asked else super().answer(packet)


class UnableHub(MuteHub):
    says = ((Command.ERROR, bytes((Command.MODULE_DETAILS, ErrorCode.NOT_SUPPORTED))),)


class OddHub(VirtualIhb):
    """It declares other channels than its module's mask has."""

    def answer(self, packet: Packet) -> list[Answer]:
        answers = super().answer(packet)
        declares = packet.command == Command.DECLARE and self.phase == Phase.RUNNING
        return [(Command.DECLARE, bytes((1, 0, 3)))] if declares else answers


@pytest.mark.parametrize(
    ("hubs", "options", "seconds", "sent"),
    [
        # nobody is there
        ([], {}, 12.0, PING * 20),
        # modules of the layout are on no hub
        ([VirtualIhb(MODULES[1:])], {"suis": [1, 2, 3]}, 60.0, VENDORS_ORDER + PING * 12),
        # a period is longer than the silence after which hubs are asked anew
        ([VirtualIhb(MODULES)], {"period_ms": 4000}, 30.0, VENDORS_ORDER),
    ],
)
def test_who_does_not_answer_is_looked_for_at_a_low_rate(
    hubs: list[VirtualIhb], options: dict[str, Any], seconds: float, sent: list[int]
) -> None:
    bus = HubBus(*hubs, **options)
    bus.run(0.0, seconds)
    assert bus.sent == sent


@pytest.mark.parametrize(
    ("stuck", "line", "rate_hz"),
    [
        (LateHub(MODULES, 7, deaf_s=1e9, says_busy=True), "still answers BUSY to ", 8.0),
        (StuckHub(MODULES, uid=7), "stays in its bootloader: switch it off and on", 8.0),
        (VirtualIhb([Module(12, 9, 0xFFF, grouping=2)], 7), "is refused: module 9 is grouped", 3.2),
        (
            OddHub([Module(12, 9, 0xFFF)], 7),
            "is refused: module 9 declares 3 channels, but its mask 0xfff has 12",
            3.2,
        ),
    ],
)
def test_a_hub_that_does_not_start_is_told_of_and_waited_for(
    stuck: VirtualIhb, line: str, rate_hz: float, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "taxeld")
    bus = HubBus(stuck)
    bus.run(0.0, 5.0)
    assert caplog.messages[:1] == ["hub 1 is in its bootloader, as after power-on; it is started"]
    bus.run(5.0, 60.0)
    assert len(caplog.messages) == 1, "it is told once"
    assert bus.bring_up.waits_for.startswith(f"hub 1 {line}")
    assert len(bus.sent) < 60 * rate_hz
    assert not stuck.auto_sync
    bus.hubs = [VirtualIhb(listed([(9, 0xFFF)]), uid=7)]
    bus.run(60.0, 67.0)
    assert bus.bring_up.waits_for == ""
    assert bus.scans > 0
    assert caplog.messages[-1] == VERSIONS_LINE


@pytest.mark.parametrize(
    ("versions", "line"),
    [
        ({}, ""),
        ({Command.VERSION: "2.1\0\xff"}, "version 2.1"),
        ({Command.MODULE_APP_VERSION: "\x1b[2J" + 99 * "é"}, "application ?[2J" + 28 * "?"),
    ],
)
def test_each_hub_is_asked_once_for_its_versions_and_what_it_says_is_told(
    versions: dict[int, str], line: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "taxeld")
    one, two = VirtualIhb(MODULES[:1], uid=7), VirtualIhb(MODULES[1:], uid=8, versions=versions)
    bus = HubBus(one, two)
    bus.run(0.0, 3.0)
    two.reboot()
    bus.run(3.0, 20.0)
    for command in (Command.VERSION, Command.MODULE_BTLDR_VERSION, Command.MODULE_APP_VERSION):
        assert bus.sent.count(command) == 1
    said = {"1": VERSIONS_LINE.removeprefix("hub 1: ")} | ({"2": line} if line else {})
    assert bus.bring_up.firmware == said
    assert [news for news in caplog.messages if "version" in news or "application" in news] == [
        f"hub {ihb}: {text}" for ihb, text in said.items()
    ]


@lates
@pytest.mark.parametrize(("ids", "lost"), [((2, 1), 0.0), ((9, 9), 0.2)])
def test_hubs_that_exchange_their_ids_keep_their_own_tables_and_lost_packets_are_asked_again(
    ids: tuple[int, int], lost: float, late: bool
) -> None:
    """What they declare under their old ids is on its way when they are given the new ones."""
    one, two = pair(*ids)
    bus = HubBus(one, two, late=late, period_ms=50, lost=lost)  # the hubs begin with that period
    bus.run(0.0, 60.0)
    bus.lost = 0.0
    bus.run(60.0, 66.0)
    before = bus.scans
    bus.run(66.0, 76.0)
    assert (one.short_id, two.short_id) == (1, 2)
    assert bus.scans - before > 2 * 190
    assert bus.wrong == 0


def test_who_keeps_what_a_table_led_to_by_its_version_takes_no_table_for_another() -> None:
    decoder, table = Decoder(), {}
    for modules in (MODULES[:1], MODULES[1:2]):
        for answer in told(VirtualIhb(modules)):
            decoder.on_packet(Packet(0.0, 1, *answer))
        table[decoder.table(1).version] = decoder.table(1).modules
        decoder.forget(1)
    assert len(table) == 2


def test_what_happens_to_one_hub_does_not_keep_another_from_streaming() -> None:
    """It does not tell of its modules, or is refused, or reboots, or is gone for good."""
    good, bad = pair()
    kinds = {"mute": MuteHub, "unable": UnableHub, "odd": OddHub}
    strange = {name: kind(MODULES[1:2], uid=8) for name, kind in kinds.items()}
    for case in (*strange, "reboots", "gone"):
        good.reboot()
        bus = HubBus(good, strange.get(case, bad), late=True)
        bus.run(0.0, 3.0)
        stops = bus.sent.count(Command.SET_AUTO_SYNC)
        if case == "reboots":
            bad.reboot()
        elif case == "gone":
            bus.hubs.remove(bad)
        sent = len(bus.sent)
        bus.run(3.0, 33.0)
        assert len(bus.scans_s[7]) >= 32 * 48, case
        assert len(bus.sent) - sent <= 12 * 7
        if case == "reboots":
            assert bad.auto_sync
            assert bus.scans_s[8][-1] > 32.9
            assert bus.sent.count(Command.SET_AUTO_SYNC) == stops + 1, "the other is not stopped"


def test_hubs_that_all_fall_silent_are_asked_at_once_though_one_was_waited_for() -> None:
    gone, heard = pair()
    bus = HubBus(gone, heard)
    bus.run(0.0, 3.0)
    bus.hubs.remove(gone)
    bus.run(3.0, 10.0)
    asked, at = len(bus.sent), 10.0
    while len(bus.sent) == asked:  # now the one that is gone is called, in vain
        bus.run(at, at + 0.1)
        at += 0.1
    bus.run(at, at + 1.0)
    heard.auto_sync, heard.period_ms, heard.short_id = False, 50, 9  # as after a reboot
    scans = bus.scans
    bus.run(at + 1.0, at + 4.0)
    assert bus.scans > scans
    assert (heard.short_id, heard.period_ms) == (2, 20)


def test_a_bus_that_makes_up_hubs_without_end_fills_no_table() -> None:
    bus = HubBus(VirtualIhb(MODULES))
    bus.run(0.0, 2.0)
    for uid in range(1000, 4000):
        answer = uid.to_bytes(4, "big")
        for ihb in (uid % 254 + 1, 9):
            bus.bring_up.on_packet(Packet(0.0, ihb, Command.DISCOVERY_PING, answer))
    named = {payload for *_, payload in bus.bring_up.due(4.0)}
    assert 0 < len(named) < SHORT_IDS, "one id is the hub's that is there"
    scans = bus.scans
    bus.run(4.0, 9.0)
    assert bus.scans - scans > 100, "the hub that is there is still heard"
