"""Bring-up against virtual hubs, on a fake clock."""

import itertools
import logging
import random
from collections import defaultdict
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import pytest

from taxeld.source.bring_up import SHORT_IDS, BringUp
from taxeld_hil.rig.virtual_ihb import Answer, Phase, VirtualIhb
from taxeld_protocol import cyskin
from taxeld_protocol.cyskin import BROADCAST, LEAVE_BOOTLOADER, Command, ErrorCode, Packet
from taxeld_protocol.decoder import Decoder
from taxeld_protocol.frames import Frame
from taxeld_protocol.modules import Module, listed, wired
from tests.rig.virtual_hub import LateHub, StuckHub

MODULES = wired([i // 10 + 1 << 4 | i % 10 + 1 for i in range(30)])
SUIS = [module.sui for module in MODULES if module.sui]
PING = [LEAVE_BOOTLOADER, Command.DISCOVERY_PING]
NAMED = [*PING, Command.DISCOVERY_RECV_ID]
ASK = [Command.DECLARE, Command.MODULE_DETAILS]
VERSIONS = [Command.VERSION, Command.MODULE_BTLDR_VERSION, Command.MODULE_APP_VERSION]
VENDORS_ORDER = [
    *(*NAMED, *ASK, Command.SET_AUTO_SYNC, Command.MODULE_PROGRAM_END, *NAMED[1:], *ASK),
    *(*VERSIONS, Command.SET_AUTO_SYNC_PERIOD, Command.SET_AUTO_SYNC),
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
        **more: Any,
    ) -> None:
        """`lost`: the share of packets that do not arrive; `suis`: modules of the layout."""
        self.hubs, self.late, self.lost, self.now = list(hubs), late, lost, 0.0
        self._rng, self._wire = random.Random(0), list[Frame]()
        self._marked: dict[int, VirtualIhb] = {}  # what a hub's channels read → the hub
        self.wrong = 0  # scans that were read by another hub's table
        self.decoder = Decoder()
        self.bring_up = BringUp(self.decoder, period_ms, **more)
        self.said: list[tuple[float, int, int]] = []  # time, to whom, command
        self.scans_s: dict[int, list[float]] = defaultdict(list)  # hub UID → times of its scans

    @property
    def sent(self) -> list[int]:
        return [command for _, _, command in self.said]

    def run(self, until: float) -> "HubBus":
        while self.now < until:
            self._hear()
            for request in self.bring_up.due(self.now):
                self.said.append((self.now, *request[:2]))
                for hub in self.hubs:
                    if self._rng.random() >= self.lost:
                        self._send(hub, hub.answer(Packet(self.now, *request)))
            for hub in self.hubs:
                if hub.due(self.now):
                    self._marked[mark := hub.uid & 0xFFFF] = hub
                    self._send(hub, hub.sensor_data([mark] * sum(m.channels for m in hub.modules)))
            if not self.late:
                self._hear()
            self.now = round(self.now + 0.01, 6)
        return self

    def _send(self, hub: VirtualIhb, answers: Any) -> None:
        for answer in answers:
            if self._rng.random() >= self.lost:
                self._wire += cyskin.to_frames(*answer, ihb=hub.short_id)

    def _hear(self) -> None:
        frames, self._wire = self._wire, []
        for packet, scans in self.decoder.take(frames):
            for scan in scans:
                self.bring_up.on_scan(scan.ihb, self.now)
                hub = self._marked[scan.counts[0]]
                self.scans_s[hub.uid].append(self.now)
                self.wrong += [m.sui for m in hub.modules] != [m.sui for m in scan.table]
            self.bring_up.on_packet(packet)


class Deaf(VirtualIhb):
    """To some commands it answers nothing, or something else."""

    to: Mapping[int, list[Answer]] = MappingProxyType({})

    def answer(self, packet: Packet) -> list[Answer]:
        command = packet.command
        return self.to[command] if command in self.to else super().answer(packet)


class Odd(VirtualIhb):
    """It declares other channels than its module's mask has."""

    def answer(self, packet: Packet) -> list[Answer]:
        answers = super().answer(packet)
        declares = packet.command == Command.DECLARE and self.phase == Phase.RUNNING
        return [(Command.DECLARE, bytes((1, 0, 3)))] if declares else answers


def pair(one: int, two: int, other: VirtualIhb | None = None) -> tuple[VirtualIhb, VirtualIhb]:
    """Two hubs of one module each, with these short ids."""
    return VirtualIhb(MODULES[:1], 7, one), other or Deaf(MODULES[1:2], 8, two)


def deaf(*to: int, says: Sequence[Answer] = (), short_id: int = 2) -> Deaf:
    """The second hub of a pair."""
    made = Deaf(MODULES[1:2], 8, short_id)
    made.to = {command: list(says) for command in to}
    return made


CANNOT_ASK = Command.ERROR, bytes((Command.MODULE_DETAILS, ErrorCode.NOT_SUPPORTED))

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
    bus = HubBus(hub, late=late).run(30.0)
    assert (hub.auto_sync, hub.period_ms) == (True, 20)
    assert bus.decoder.table(1).modules == hub.modules
    assert len(bus.scans_s[hub.uid]) > 1400
    assert bus.sent == VENDORS_ORDER
    for at, pause_s in ((0, 0.1), (5, 0.06), (6, 0.5)):  # as the vendor's library has them
        (before, *_), (after, *_) = bus.said[at : at + 2]
        assert pause_s <= round(after - before, 6) < pause_s + 0.03


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
    bus = HubBus(*[other] * beside, late=late, suis=SUIS)
    for at in powered:
        bus.run(at).hubs.append(hub)
        bus.run(at + 12.5)
        started = [t for t, _, command in bus.said if command == Command.MODULE_PROGRAM_END]
        can_s = min(t for t in started if t >= at) + options.get("modules_s", 0.0)
        assert min(t for t in bus.scans_s[8] if t >= at) <= max(at + 6.0, can_s + 6.0)
        assert bus.scans_s[8][-1] > at + 12.4
        hub.reboot()
        bus.hubs.remove(hub)
    assert bus.wrong == 0
    if beside:  # with its id, what was declared under it may be the other hub's: it is asked again
        shared = short_id == 1
        assert max(b - a for a, b in itertools.pairwise(bus.scans_s[7])) < (0.2 if shared else 0.1)
        begin = bus.scans_s[7][0]
        heard = {command for t, to, command in bus.said if t > begin and to in (1, BROADCAST)}
        assert heard <= {*NAMED, *ASK * shared}


@pytest.mark.parametrize(
    ("hubs", "options", "sent"),
    [
        ([], {}, PING * 15),
        ([VirtualIhb(MODULES[1:])], {"suis": SUIS}, VENDORS_ORDER + NAMED * 16),
        ([VirtualIhb(MODULES)], {"period_ms": 4000}, VENDORS_ORDER),
    ],
    ids=[
        "nobody is there: at doubling pauses, of four seconds at most",
        "modules are on no hub: by discovery alone",
        "a period is longer than the silence: not at all",
    ],
)
def test_who_is_missing_is_looked_for(
    hubs: list[VirtualIhb], options: dict[str, Any], sent: list[int]
) -> None:
    bus = HubBus(*hubs, **options).run(60.0)
    assert bus.sent == sent
    begun = [t for t, _, command in bus.said if command == LEAVE_BOOTLOADER]
    pauses = [round(b - a, 1) for a, b in itertools.pairwise(begun[bool(hubs) :])]
    assert pauses == sorted(pauses)
    assert all(pause < 4.8 for pause in pauses)


@pytest.mark.parametrize(
    ("stuck", "line"),
    [
        (LateHub(MODULES, 7, deaf_s=1e9, says_busy=True), "still answers BUSY to "),
        (StuckHub(MODULES, uid=7), "stays in its bootloader: switch it off and on"),
        (VirtualIhb([Module(12, 9, 0xFFF, grouping=2)], 7), "is refused: module 9 is grouped"),
        (
            Odd([Module(12, 9, 0xFFF)], 7),
            "is refused: module 9 declares 3 channels, but its mask 0xfff has 12",
        ),
    ],
)
def test_a_hub_that_does_not_start_is_told_of_and_waited_for(
    stuck: VirtualIhb, line: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "taxeld")
    bus = HubBus(stuck).run(5.0)
    assert caplog.messages[:1] == ["hub 1 is in its bootloader, as after power-on; it is started"]
    bus.run(60.0)
    assert len(caplog.messages) == 1, "it is told once"
    assert bus.bring_up.waits_for.startswith(f"hub 1 {line}")
    assert len(bus.sent) < 60 * 4
    assert not stuck.auto_sync
    bus.hubs = [VirtualIhb(listed([(9, 0xFFF)]), uid=7)]
    bus.run(67.0)
    assert bus.bring_up.waits_for == ""
    assert bus.scans_s[7]
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
    bus = HubBus(one, two).run(3.0)
    two.reboot()
    bus.run(20.0)
    assert [bus.sent.count(command) for command in VERSIONS] == [1, 1, 1]
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
    bus = HubBus(*pair(*ids), late=late, period_ms=50, lost=lost).run(60.0)
    bus.lost = 0.0
    bus.run(78.0)
    assert [hub.short_id for hub in bus.hubs] == [1, 2]
    assert all(sum(t > 68.0 for t in bus.scans_s[hub.uid]) > 190 for hub in bus.hubs)
    assert bus.wrong == 0


@pytest.mark.parametrize(
    "bad",
    [
        deaf(Command.MODULE_DETAILS),
        deaf(Command.DISCOVERY_RECV_ID),
        deaf(Command.MODULE_DETAILS, says=[CANNOT_ASK]),
        Odd(MODULES[1:2], 8, 2),
        LateHub(MODULES[1:2], 8, 2),
        VirtualIhb(MODULES[1:2], 8, 2),
    ],
    ids=["is mute", "takes no id", "cannot ask its modules", "is refused", "reboots", "is gone"],
)
def test_what_happens_to_one_hub_does_not_keep_another_from_streaming(bad: VirtualIhb) -> None:
    bus = HubBus(*pair(1, 2, bad), late=True).run(3.0)
    begun = len(bus.said)
    bad.reboot()
    if type(bad) is VirtualIhb:
        bus.hubs.remove(bad)
    bus.run(33.0)
    assert len(bus.scans_s[7]) >= 30 * 48
    assert len(bus.said) - begun <= 30 * 5
    asked = {command for _, to, command in bus.said[begun:] if to in (1, BROADCAST)}
    assert asked <= {*NAMED}, "the other is left alone"
    assert not isinstance(bad, LateHub) or bus.scans_s[8][-1] > 32.9


@pytest.mark.parametrize("to", [Command.DISCOVERY_RECV_ID, Command.DISCOVERY_PING])
def test_of_two_hubs_that_share_an_id_neither_is_misread_once_that_is_known(to: int) -> None:
    """None streams while one does not take its own id."""
    two = deaf(to, short_id=1)
    bus = HubBus(*pair(1, 1, two), suis=SUIS[:2]).run(30.0)
    assert bool(bus.wrong) is bool(bus.scans_s) is (to == Command.DISCOVERY_PING)
    two.to = {}
    wrong = bus.run(36.0).wrong
    bus.run(40.0)
    assert min(bus.scans_s[7][-1], bus.scans_s[8][-1]) > 39.9
    assert bus.wrong == wrong


def test_hubs_that_all_fall_silent_are_asked_at_once_though_one_was_waited_for() -> None:
    gone, heard = pair(1, 2)
    bus = HubBus(gone, heard).run(3.0)
    bus.hubs.remove(gone)
    bus.run(20.0)
    asked = len(bus.sent)
    while len(bus.sent) == asked:  # now the one that is gone is called, in vain
        bus.run(bus.now + 0.1)
    bus.run(bus.now + 1.0)
    heard.auto_sync, heard.period_ms, heard.short_id = False, 50, 9  # as after a reboot
    at = bus.now
    bus.run(at + 3.0)
    assert bus.scans_s[8][-1] > at + 2.9
    assert (heard.short_id, heard.period_ms) == (2, 20)


def test_a_bus_that_makes_up_hubs_without_end_fills_no_table() -> None:
    bus = HubBus(VirtualIhb(MODULES, uid=7)).run(2.0)
    for uid in range(1000, 4000):
        answer = uid.to_bytes(4, "big")
        for ihb in (uid % 254 + 1, 9):
            bus.bring_up.on_packet(Packet(0.0, ihb, Command.DISCOVERY_PING, answer))
    named = {payload for *_, payload in bus.bring_up.due(4.0)}
    assert 0 < len(named) < SHORT_IDS, "one id is the hub's that is there"
    bus.run(9.0)
    assert sum(t > 4.0 for t in bus.scans_s[7]) > 100, "the hub that is there is still heard"
