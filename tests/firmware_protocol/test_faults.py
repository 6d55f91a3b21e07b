"""Each fault of the wire: what it costs, and that it costs no more."""

from collections.abc import Callable

import pytest

from taxeld_protocol import cyskin
from taxeld_protocol.cyskin import FRAGMENT_BYTES, Command
from taxeld_protocol.decoder import MISSING, Decoder, Scan
from taxeld_protocol.frames import Frame
from taxeld_protocol.modules import Module
from taxeld_protocol.virtual_ihb import VirtualIhb

MODULES = [Module(12, sui=i + 1, mask=0xFFF) for i in range(20)]  # 240 channels: 2 packets
CHANNELS = 240


def sent(value: int, t: float, ihb: int = 1) -> list[Frame]:
    """A scan whose every channel reads `value`."""
    hub = VirtualIhb(MODULES, short_id=ihb)
    return [
        frame
        for command, payload in hub.sensor_data([value] * CHANNELS)
        for frame in cyskin.to_frames(command, payload, ihb=ihb, t=t)
    ]


def read(frames: list[Frame], decoder: Decoder | None = None) -> list[Scan]:
    decoder = decoder or Decoder(lambda _: MODULES)
    return [scan for frame in frames for scan in decoder.feed(frame)[1]]


def filled(scan: Scan) -> set[int]:
    return set(scan.counts) - {MISSING}


FIRST_PACKET = sum(1 for _ in range(-(-(2 + 126 * 2 + 3) // FRAGMENT_BYTES)))


def without(frames: list[Frame], at: int) -> list[Frame]:
    return frames[:at] + frames[at + 1 :]


@pytest.mark.parametrize(
    "damage",
    [
        lambda frames: without(frames, 0),
        lambda frames: without(frames, 5),
        lambda frames: without(frames, FIRST_PACKET - 1),
        lambda frames: without(frames, FIRST_PACKET),
        lambda frames: [*frames[:6], *frames[5:]],
        lambda frames: [*frames[:3], frames[4]._replace(data=bytes(8)), frames[3], *frames[5:]],
        lambda frames: [*frames[:2], frames[2]._replace(data=b"\x55" * 8), *frames[3:]],
    ],
    ids=[
        "first lost",
        "middle lost",
        "last lost",
        "first of the second lost",
        "one twice",
        "two out of order",
        "bits flipped",
    ],
)
def test_a_damaged_fragment_costs_its_packet_and_shifts_nothing(
    damage: Callable[[list[Frame]], list[Frame]],
) -> None:
    decoder = Decoder(lambda _: MODULES)
    damaged, whole = read(damage(sent(100, t=0.0)) + sent(200, t=0.05), decoder)
    assert filled(damaged) == {100}
    assert damaged.counts.count(MISSING) in (126, CHANNELS - 126)
    assert whole.counts == (200,) * CHANNELS
    assert decoder.counters.incomplete == 1


def test_a_duplicated_packet_invents_no_value() -> None:
    frames = sent(100, t=0.0)
    scans = read(frames[:FIRST_PACKET] + frames)
    assert [scan.complete for scan in scans] == [False, True]
    assert all(filled(scan) == {100} for scan in scans)


def test_a_reboot_in_mid_scan_ends_it_where_it_was() -> None:
    """The hub falls silent after a packet and a half, is declared anew and begins again."""
    decoder = Decoder(lambda _: MODULES)
    cut = sent(100, t=0.0)[: FIRST_PACKET + 4]
    declare = cyskin.to_frames(Command.DECLARE, bytes((20, 0)) + bytes([12] * 20), ihb=1, t=2.0)
    scans = read(cut + declare + sent(200, t=3.0), decoder)
    assert [scan.counts.count(MISSING) for scan in scans] == [CHANNELS - 126, 0]
    assert [filled(scan) for scan in scans] == [{100}, {200}]


def test_a_silent_device_ends_nothing_and_begins_afresh() -> None:
    decoder = Decoder(lambda _: MODULES)
    assert read(sent(100, t=0.0)[:FIRST_PACKET], decoder) == []
    old, new = read(sent(200, t=60.0), decoder)
    assert (filled(old), filled(new)) == ({100}, {200})
    assert new.complete
