"""Each fault of the wire: what it costs, and that it costs no more."""

import pytest

from taxeld_protocol import cyskin
from taxeld_protocol.cyskin import FRAGMENT_BYTES, MAX_PAYLOAD, Command, Reassembler
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


@pytest.mark.parametrize(
    ("lost", "what"),
    [(0, "first"), (5, "middle"), (FIRST_PACKET - 1, "last"), (FIRST_PACKET, "first of second")],
)
def test_a_lost_fragment_costs_its_packet_and_shifts_nothing(lost: int, what: str) -> None:
    frames = sent(100, t=0.0)
    decoder = Decoder(lambda _: MODULES)
    scans = read(frames[:lost] + frames[lost + 1 :] + sent(200, t=0.05), decoder)
    damaged, whole = scans
    assert filled(damaged) == {100}, what
    assert damaged.counts.count(MISSING) in (126, CHANNELS - 126)
    assert whole.counts == (200,) * CHANNELS
    assert decoder.counters.incomplete == 1


def test_a_duplicated_fragment_costs_its_packet() -> None:
    frames = sent(100, t=0.0)
    decoder = Decoder(lambda _: MODULES)
    scans = read([*frames[:6], frames[5], *frames[6:], *sent(200, t=0.05)], decoder)
    assert [filled(scan) for scan in scans] == [{100}, {200}]
    assert scans[1].complete
    assert decoder.link.counters.crc_errors + decoder.link.counters.length_errors == 1


def test_a_duplicated_packet_invents_no_value() -> None:
    frames = sent(100, t=0.0)
    scans = read(frames[:FIRST_PACKET] + frames)
    assert [scan.complete for scan in scans] == [False, True]
    assert all(filled(scan) == {100} for scan in scans)


def test_fragments_out_of_order_cost_their_packet() -> None:
    frames = sent(100, t=0.0)
    frames[3], frames[4] = frames[4]._replace(data=b"\0" * 8), frames[3]
    scans = read(frames + sent(200, t=0.05))
    assert scans[-1].counts == (200,) * CHANNELS
    assert all(filled(scan) <= {100, 200} for scan in scans)


def test_two_hubs_interleaved_frame_by_frame() -> None:
    pairs = zip(sent(1, 0.0, ihb=1), sent(2, 0.0, ihb=2), strict=True)
    scans = read([frame for pair in pairs for frame in pair])
    assert sorted((scan.ihb, scan.counts) for scan in scans) == [
        (1, (1,) * CHANNELS), (2, (2,) * CHANNELS),
    ]  # fmt: skip


def test_a_reboot_in_mid_scan_ends_it_where_it_was() -> None:
    """The hub falls silent after a packet and a half, is declared anew and begins again."""
    decoder = Decoder(lambda _: MODULES)
    cut = sent(100, t=0.0)[: FIRST_PACKET + 4]
    declare = cyskin.to_frames(Command.DECLARE, bytes((20, 0)) + bytes([12] * 20), ihb=1, t=2.0)
    scans = read(cut + declare + sent(200, t=3.0), decoder)
    assert [scan.counts.count(MISSING) for scan in scans] == [CHANNELS - 126, 0]
    assert [filled(scan) for scan in scans] == [{100}, {200}]


def test_a_module_table_that_changes_ends_the_scan_of_the_old_one() -> None:
    decoder = Decoder(lambda _: MODULES)
    half = sent(100, t=0.0)[:FIRST_PACKET]
    fewer = cyskin.to_frames(Command.DECLARE, bytes((1, 0, 2)), ihb=1, t=0.01)
    short = cyskin.to_frames(Command.SENSOR_DATA, bytes((0, 0, 0, 7, 0, 8)), ihb=1, t=0.015)
    old, new = read(half + fewer + short, decoder)
    assert (len(old.counts), filled(old)) == (CHANNELS, {100})
    assert new.counts == (7, 8)
    assert new.table_version != old.table_version


def test_a_checksum_error_costs_its_packet() -> None:
    frames = sent(100, t=0.0)
    frames[2] = frames[2]._replace(data=b"\x55" + frames[2].data[1:])
    decoder = Decoder(lambda _: MODULES)
    scans = read(frames + sent(200, t=0.05), decoder)
    assert [filled(scan) for scan in scans] == [{100}, {200}]
    assert decoder.link.counters.crc_errors == 1


def test_an_index_past_the_tree_drops_the_rest_of_the_packet() -> None:
    decoder = Decoder(lambda _: [Module(2)])
    payload = bytes((0, 0)) + b"\0\1" * 5
    (scan,) = read(cyskin.to_frames(Command.SENSOR_DATA, payload, ihb=1), decoder)
    assert scan.counts == (1, 1)
    assert decoder.counters.index_errors == 1
    past = cyskin.to_frames(Command.SENSOR_DATA, bytes((9, 0, 0, 1)), ihb=1)
    assert read(past, decoder) == []
    assert decoder.counters.index_errors == 2


def test_a_packet_longer_than_any_is_dropped_and_the_next_is_read() -> None:
    link = Reassembler()
    link.feed(Frame(0.0, 0x101, bytes(8)))
    for _ in range(MAX_PAYLOAD):
        assert link.feed(Frame(0.0, 0x201, bytes(8))) is None
    assert link.feed(Frame(0.0, 0x401, b"")) is None
    assert link.counters.length_errors == 1
    good = [link.feed(frame) for frame in cyskin.to_frames(Command.PING, b"", ihb=1)]
    assert good[-1] is not None


def test_bytes_after_the_checksum_are_ignored() -> None:
    """A receiver drops what is shorter than N + 3, not what is longer."""
    packet = cyskin.encode(Command.PING) + b"\x99\x99"
    (frame,) = cyskin.fragment(packet, 1)
    assert Reassembler().feed(frame) is not None


def test_a_silent_device_ends_nothing_and_begins_afresh() -> None:
    decoder = Decoder(lambda _: MODULES)
    assert read(sent(100, t=0.0)[:FIRST_PACKET], decoder) == []
    old, new = read(sent(200, t=60.0), decoder)
    assert (filled(old), filled(new)) == ({100}, {200})
    assert new.complete
