"""Bring-up against the virtual hub, on a fake clock."""

from taxeld.bring_up import BringUp, Request
from taxeld_protocol import cyskin
from taxeld_protocol.cyskin import BROADCAST, Command
from taxeld_protocol.decoder import Decoder
from taxeld_protocol.modules import wired
from taxeld_protocol.virtual_ihb import VirtualIhb

UIDS = [i // 10 + 1 << 4 | i % 10 + 1 for i in range(30)]


class Bus:
    """Hubs and a host that talk without delay; time is what `run` says."""

    def __init__(self, *hubs: VirtualIhb) -> None:
        self.hubs = list(hubs)
        self.decoder = Decoder()
        self.bring_up = BringUp(self.decoder, period_ms=20)
        self.scans = 0
        self.sent: list[int] = []

    def run(self, start: float, stop: float) -> None:
        now = start
        while now < stop:
            for request in self.bring_up.due(now):
                self._ask(*request)
            for hub in self.hubs:
                if hub.due(now):
                    channels = sum(module.channels for module in hub.modules)
                    for answer in hub.sensor_data([100] * channels):
                        self._hear(hub.short_id, answer, now)
            now = round(now + 0.01, 6)

    def _ask(self, command: int, payload: bytes) -> None:
        self.sent.append(command)
        packet = cyskin.Packet(0.0, BROADCAST, command, payload)
        for hub in self.hubs:
            for answer in hub.answer(packet):
                self._hear(hub.short_id, answer, 0.0)

    def _hear(self, ihb: int, answer: Request, now: float) -> None:
        for frame in cyskin.to_frames(*answer, ihb=ihb):
            packet, scans = self.decoder.feed(frame)
            self.scans += len(scans)
            if scans:
                self.bring_up.on_scan(now)
            if packet:
                for request in self.bring_up.on_packet(packet):
                    self._ask(*request)


def test_a_hub_is_found_asked_and_started() -> None:
    hub = VirtualIhb(wired(UIDS))
    bus = Bus(hub)
    bus.run(0.0, 2.0)
    assert hub.auto_sync
    assert hub.period_ms == 20
    assert bus.decoder.table(1).modules == hub.modules
    assert bus.scans > 80
    assert bus.sent[:3] == [Command.DISCOVERY_PING, Command.DECLARE, Command.MODULE_DETAILS]


def test_once_scans_come_nothing_more_is_sent() -> None:
    bus = Bus(VirtualIhb(wired(UIDS)))
    bus.run(0.0, 2.0)
    sent = len(bus.sent)
    bus.run(2.0, 60.0)
    assert len(bus.sent) == sent


def test_two_hubs_get_short_ids_of_their_own() -> None:
    one = VirtualIhb(wired(UIDS[:10]), uid=7, short_id=9)
    two = VirtualIhb(wired(UIDS[10:]), uid=8, short_id=9)
    bus = Bus(one, two)
    bus.run(0.0, 0.1)
    assert (one.short_id, two.short_id) == (1, 2)


def test_a_hub_that_rebooted_is_started_again() -> None:
    hub = VirtualIhb(wired(UIDS))
    bus = Bus(hub)
    bus.run(0.0, 2.0)
    hub.auto_sync, hub.period_ms, hub.short_id = False, 50, 9
    bus.run(2.0, 5.0)
    assert hub.auto_sync
    assert (hub.short_id, hub.period_ms) == (1, 20)


def test_silence_is_asked_at_a_steady_low_rate() -> None:
    bus = Bus()
    bus.run(0.0, 10.0)
    assert len(bus.sent) == 3 * 20
