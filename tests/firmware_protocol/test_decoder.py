"""Scans out of packets: the module table, the walk, and what is missing."""

from collections.abc import Callable, Iterable
from itertools import chain

import pytest
from hypothesis import given
from hypothesis import strategies as st

from taxeld_hil.rig.virtual_ihb import Phase, VirtualIhb, details
from taxeld_protocol import cyskin
from taxeld_protocol.cyskin import MAX_VALUES, Command, Packet
from taxeld_protocol.decoder import MISSING, Decoder, Scan
from taxeld_protocol.frames import Frame
from taxeld_protocol.modules import ABSENT_UID, Module, ModuleTable, listed, wired

MODULES = wired([(i // 10 + 1) << 4 | (i % 10 + 1) for i in range(250)])  # 275 channels, 3 packets
CHANNELS = sum(m.channels for m in MODULES)


def feed(
    decoder: Decoder, command: int, payload: bytes, ihb: int = 1, t: float = 0.0
) -> list[Scan]:
    return scans_of(decoder, cyskin.to_frames(command, payload, ihb=ihb, t=t))


def scans_of(decoder: Decoder, frames: Iterable[Frame]) -> list[Scan]:
    return [scan for _, ended in decoder.take(frames) for scan in ended]


def scan_frames(counts: list[int], ihb: int = 1, t: float = 0.0) -> list[list[Frame]]:
    """Frames of each packet of a scan."""
    answers = VirtualIhb(MODULES, short_id=ihb).sensor_data(counts)
    return [cyskin.to_frames(command, payload, ihb=ihb, t=t) for command, payload in answers]


@given(st.integers(0, 250))
def test_the_frames_of_a_scan_are_known_beforehand(values: int) -> None:
    hub = VirtualIhb([Module(1)] * values)
    sent = [cyskin.to_frames(*packet, ihb=1) for packet in hub.sensor_data([0] * values)]
    assert cyskin.scan_frames(values) == sum(map(len, sent))


def declared() -> Decoder:
    return Decoder(lambda _: MODULES)


def test_the_table_comes_from_declare_and_details() -> None:
    decoder = Decoder()
    feed(decoder, Command.DECLARE, bytes((2, 0, 3, 11)))
    assert not decoder.table(1).detailed
    feed(decoder, Command.MODULE_DETAILS, details(0, Module(3, 0x1234, 0b1000_0000_0011)))
    feed(decoder, Command.MODULE_DETAILS, details(1, Module(11, 7, 0x7FF)))
    table = decoder.table(1)
    assert table.detailed
    assert table.modules[0].uids == [0x12340, 0x12341, 0x1234B]  # T0, T1 and T11 are uncut
    assert table.modules[1].uids[:2] == [0x70, 0x71]


def test_requests_on_the_bus_change_no_table() -> None:
    decoder = Decoder()
    feed(decoder, Command.DECLARE, b"", ihb=1)
    feed(decoder, Command.MODULE_DETAILS, b"\xff", ihb=1)
    assert not decoder.table(1).declared
    assert decoder.counters.malformed == 0


def test_sensor_data_before_its_table_is_counted_not_guessed() -> None:
    decoder = Decoder()
    assert feed(decoder, Command.SENSOR_DATA, bytes(6)) == []
    assert decoder.counters.undeclared == 1


# what becomes of a packet's frames, number `at` of them above all, and how often it comes whole
HAPPENS: dict[str, tuple[Callable[[list[Frame], int], list[Frame]], Callable[[int, int], int]]] = {
    "nothing": (lambda frames, _: frames, lambda *_: 1),
    "all are lost": (lambda *_: [], lambda *_: 0),
    "one is lost": (lambda frames, at: frames[:at] + frames[at + 1 :], lambda *_: 0),
    "one comes twice": (
        lambda frames, at: frames[: at + 1] + frames[at:],
        lambda at, last: int(at in (0, last)),
    ),
    "two change places": (lambda frames, at: swapped(frames, max(at, 1)), lambda *_: 0),
    "a bit is flipped": (
        lambda frames, at: [*frames[:at], flipped(frames[at]), *frames[at + 1 :]],
        lambda *_: 0,
    ),
    "all come twice": (lambda frames, _: frames * 2, lambda *_: 2),
}


def swapped(frames: list[Frame], at: int) -> list[Frame]:
    return [*frames[: at - 1], frames[at], frames[at - 1], *frames[at + 1 :]]


def flipped(frame: Frame) -> Frame:
    return frame._replace(data=frame.data[:-1] + bytes((frame.data[-1] ^ 1,)))


@given(st.lists(st.tuples(st.sampled_from([*HAPPENS]), st.integers(0, 36)), min_size=6, max_size=6))
def test_damage_costs_its_packet_shifts_nothing_and_mixes_no_scans(
    happens: list[tuple[str, int]],
) -> None:
    """Two scans of three packets: whatever arrives stands where it belongs, and nothing else."""
    decoder, scans = declared(), []
    first, second = [1000 + i for i in range(CHANNELS)], [5000 + i for i in range(CHANNELS)]
    sent, wanted = scan_frames(first, t=1.0) + scan_frames(second, t=60.0), []
    for n, (frames, (what, number)) in enumerate(zip(sent, happens, strict=True)):
        damage, whole = HAPPENS[what]
        at = number % len(frames)
        scans += scans_of(decoder, damage(frames, at))
        low, source = n % 3 * 126, first if n < 3 else second
        values = [(i, source[i]) for i in range(low, min(low + 126, CHANNELS))]
        wanted += values * whole(at, len(frames) - 1)
    scans += decoder.flush()
    assert [(i, v) for s in scans for i, v in enumerate(s.counts) if v != MISSING] == wanted
    assert all(len({v // 4000 for v in s.counts if v != MISSING}) == 1 for s in scans)
    assert decoder.counters.incomplete == sum(MISSING in scan.counts for scan in scans)


def test_two_hubs_keep_their_scans_apart() -> None:
    decoder, scans = declared(), []
    one, two = scan_frames([1] * CHANNELS, ihb=1), scan_frames([2] * CHANNELS, ihb=2)
    for a, b in zip(one, two, strict=True):
        scans += scans_of(decoder, chain(*zip(a, b, strict=True)))
    assert sorted((s.ihb, set(s.counts)) for s in scans) == [(1, {1}), (2, {2})]


def test_values_past_the_tree_are_dropped_and_counted() -> None:
    decoder = Decoder(lambda _: [Module(2)])
    assert feed(decoder, Command.SENSOR_DATA, bytes((0, 0)) + bytes(range(8)))[0].counts == (1, 515)
    assert feed(decoder, Command.SENSOR_DATA, bytes((0, 2, 0, 1))) == []
    assert feed(decoder, Command.SENSOR_DATA, bytes((1, 0, 0, 1))) == []
    assert feed(decoder, Command.SENSOR_DATA, bytes((0, 0, 1))) == []
    assert decoder.counters.index_errors == 4


def test_modules_without_channels_are_walked_over() -> None:
    decoder = Decoder(lambda _: [Module(1), Module(0), Module(1)])
    (scan,) = feed(decoder, Command.SENSOR_DATA, bytes((0, 0, 0, 7, 0, 9)))
    assert scan.by_module == [[7], [], [9]]


@pytest.mark.parametrize("channels", [2, 4])
def test_a_hub_that_declares_its_modules_ends_the_scan_under_way(channels: int) -> None:
    """Be they others, or the same again, as after a reboot amid a packet."""
    decoder = Decoder()
    feed(decoder, Command.DECLARE, bytes((1, 0, 4)))
    assert feed(decoder, Command.SENSOR_DATA, bytes((0, 0, 0, 1))) == []
    cut = cyskin.to_frames(Command.SENSOR_DATA, bytes((0, 1, 0, 2, 0, 3)), ihb=1)[:1]
    assert scans_of(decoder, cut) == []
    feed(decoder, Command.DECLARE, bytes((1, 0, channels)))
    counts = list(range(5, 5 + channels))
    data = b"".join(value.to_bytes(2) for value in counts)
    old, new = feed(decoder, Command.SENSOR_DATA, bytes(2) + data)
    assert old.counts == (1, MISSING, MISSING, MISSING)
    assert list(new.counts) == counts


@given(st.lists(st.tuples(st.integers(0, 255), st.binary(max_size=40)), max_size=30))
def test_any_packets_leave_the_decoder_standing(packets: list[tuple[int, bytes]]) -> None:
    decoder = Decoder()
    for command, payload in packets:
        feed(decoder, command, payload)
    stats = decoder.stats()
    assert stats["frames"] == stats["used"] + sum(stats["dropped"].values()) + stats["pending"]
    counts = [101] * 12
    feed(decoder, Command.DECLARE, bytes((1, 0, 12)), ihb=77)
    (scan,) = feed(decoder, Command.SENSOR_DATA, bytes(2) + bytes((0, 101)) * 12, ihb=77)
    assert list(scan.counts) == counts


@given(st.binary(max_size=300))
def test_module_tables_are_bounded(payload: bytes) -> None:
    table = ModuleTable()
    table.on_declare(payload)
    table.on_details(payload[:11])
    assert len(table.modules) <= 248
    assert all(module.channels <= 12 for module in table.modules)


def test_scans_that_never_came_are_missed_and_long_pauses_are_none() -> None:
    """A scan of a single packet that is lost leaves no trace but the time without it."""
    decoder = declared()
    missed = []
    for t in (0.0, 0.05, 0.1, 0.152, 0.3, 0.35, 1.3, 3.0, 3.05):
        scans_of(decoder, chain(*scan_frames([7] * CHANNELS, t=t)))
        missed.append(decoder.counters.missed)
    assert missed == [0, 0, 0, 0, 2, 2, 20, 20, 20]


def test_a_module_that_says_nothing_leaves_its_channels_missing_and_no_others() -> None:
    decoder, dead = declared(), MODULES[0].channels
    counts: list[int | None] = list(range(CHANNELS))
    counts[dead : 2 * dead] = [None] * dead
    hub = VirtualIhb(MODULES)
    scans = [scan for answer in hub.sensor_data(counts) for scan in feed(decoder, *answer)]
    assert [value if value is not None else MISSING for value in counts] == list(scans[0].counts)
    assert (decoder.counters.scans, decoder.counters.incomplete) == (1, 1)


CUT = 0x76D  # the mask of a public patch's only cut module, its tenth
READINGS = {"possible": 12, "sent": None}  # what MODULE_DETAILS may tell of its channels
READING = pytest.mark.parametrize("details_channels", READINGS.values(), ids=READINGS.keys())


def answers(hub: VirtualIhb, command: Command, payload: bytes = b"") -> list[Packet]:
    return [Packet(0.0, 1, *a) for a in hub.answer(Packet(0.0, 0xFF, command, payload))]


def patch(masks: list[int], details_channels: int | None) -> VirtualIhb:
    """A hub that runs, whose modules' serial numbers fall."""
    modules = listed((100 - i, mask) for i, mask in enumerate(masks))
    return VirtualIhb(modules, phase=Phase.RUNNING, details_channels=details_channels)


def told(decoder: Decoder, hub: VirtualIhb, *commands: Command) -> None:
    for command in commands:
        payload = b"\xff" if command == Command.MODULE_DETAILS else b""
        for packet in answers(hub, command, payload):
            decoder.on_packet(packet)


def placed(decoder: Decoder, hub: VirtualIhb, length: int) -> dict[int, int]:
    """UID → count, of a scan in packets of so many values, each taxel reading its own UID."""
    uids = [uid for module in hub.modules for uid in module.uids]
    places = [(m, c) for m, module in enumerate(hub.modules) for c in range(module.channels)]
    scans = []
    for at in range(0, len(uids), length):
        values = b"".join(uid.to_bytes(2) for uid in uids[at : at + length])
        packet = Packet(1.0, 1, Command.SENSOR_DATA, bytes(places[at]) + values)
        scans += decoder.on_packet(packet)
    [scan] = scans
    assert scan.complete
    assert decoder.counters.index_errors == 0
    got = [uid for module in scan.table for uid in module.uids]
    return dict(zip(got, scan.counts, strict=True))


ORDERS = [
    (Command.DECLARE, Command.MODULE_DETAILS),
    (Command.MODULE_DETAILS, Command.DECLARE),
    (Command.MODULE_DETAILS,),
]


@READING
@pytest.mark.parametrize("order", ORDERS, ids=lambda order: " ".join(c.name for c in order))
@given(
    masks=st.lists(st.integers(0, 0xFFF), min_size=1, max_size=12).filter(any),
    length=st.integers(1, MAX_VALUES),
)
def test_cut_modules_are_read_right_at_every_packet_length_whatever_details_tell(
    details_channels: int | None, order: tuple[Command, ...], masks: list[int], length: int
) -> None:
    hub, decoder = patch(masks, details_channels), Decoder()
    told(decoder, hub, *order)
    assert decoder.table(1).detailed
    assert all(uid == count for uid, count in placed(decoder, hub, length).items())


@READING
def test_a_module_that_is_cut_while_it_is_known_is_told_anew(details_channels: int | None) -> None:
    """By either answer alone: what only the other had told is of before."""
    for command in (Command.DECLARE, Command.MODULE_DETAILS):
        hub, decoder = patch([0xFFF, 0xFFF], details_channels), Decoder()
        told(decoder, hub, Command.DECLARE, Command.MODULE_DETAILS)
        hub.answer(Packet(0.0, 0xFF, Command.MODULE_SET_CUT_SENSORS, b"\x00\x00\x0f"))
        told(decoder, hub, command)
        assert [module.channels for module in decoder.table(1).modules] == [8, 12]
        uids = decoder.table(1).modules[0].uids
        wanted = hub.modules[0].uids if command == Command.MODULE_DETAILS else [ABSENT_UID] * 8
        assert uids == wanted


def test_nothing_is_known_past_a_module_that_was_not_told() -> None:
    """Where its channels end, and the next module's begin, nobody can say."""
    table = ModuleTable()
    for index in (0, 2):
        table.on_details(details(index, Module(12, index + 1, 0xFFF)))
    assert [module.sui for module in table.modules] == [1]
    assert not table.detailed
    table.on_details(details(1, Module(12, 2, CUT), 12))
    assert [(module.sui, module.channels) for module in table.modules] == [(1, 12), (2, 8), (3, 12)]
    assert table.detailed


def test_answers_from_the_bootloader_tell_no_channels_and_take_none_away() -> None:
    hub, decoder = patch([0xFFF, CUT], 12), Decoder()
    told(decoder, hub, Command.DECLARE, Command.MODULE_DETAILS)
    before = decoder.table(1).modules
    assert not decoder.table(1).in_bootloader
    hub.phase = Phase.BOOTLOADER
    told(decoder, hub, Command.DECLARE, Command.MODULE_DETAILS)
    assert decoder.table(1).modules == before
    assert decoder.table(1).in_bootloader
    assert (decoder.counters.bootloader, decoder.counters.malformed) == (3, 0)
    hub.phase = Phase.RUNNING
    told(decoder, hub, Command.DECLARE)
    assert not decoder.table(1).in_bootloader


def test_what_is_given_is_used_until_the_wire_contradicts_it() -> None:
    given = listed([(7, 0xFFF), (3, CUT)])
    asked: list[int] = []

    def assumed(ihb: int) -> list[Module]:
        asked.append(ihb)
        return given

    decoder = Decoder(assumed)
    data = Packet(0.0, 1, Command.SENSOR_DATA, bytes(2) + b"\1\2" * 20)
    assert [scan.table for scan in decoder.on_packet(data)] == [tuple(given)]
    decoder.on_packet(Packet(0.0, 1, Command.DECLARE, bytes((2, 0, 12, 8))))
    assert [module.sui for module in decoder.table(1).modules] == [7, 3]
    decoder.on_packet(Packet(0.0, 1, Command.DECLARE, bytes((2, 0, 11, 8))))
    assert [module.sui for module in decoder.table(1).modules] == [None, 3]
    assert asked == [1]


def test_a_given_table_of_other_channels_than_were_declared_is_not_used() -> None:
    decoder = Decoder(lambda _: listed([(7, 0xFFF), (3, 0xFFF)]))
    decoder.on_packet(Packet(0.0, 1, Command.DECLARE, bytes((2, 0, 12, 8))))
    data = Packet(0.0, 1, Command.SENSOR_DATA, bytes(2) + b"\1\2" * 20)
    [scan] = decoder.on_packet(data)
    assert [uid for module in scan.table for uid in module.uids] == [ABSENT_UID] * 20
