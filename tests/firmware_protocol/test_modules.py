"""Which channels a module sends, and whose they are, whatever its hub tells and in which order."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from taxeld_hil.rig.virtual_ihb import Phase, VirtualIhb, details
from taxeld_protocol.cyskin import MAX_VALUES, Command, Packet
from taxeld_protocol.decoder import Decoder
from taxeld_protocol.modules import ABSENT_UID, Module, ModuleTable, listed

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
