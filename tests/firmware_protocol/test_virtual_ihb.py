"""The virtual hub answers as the wire's facts say."""

import pytest

from taxeld_protocol.cyskin import Command, ErrorCode, Packet
from taxeld_protocol.modules import wired
from taxeld_protocol.virtual_ihb import VirtualIhb

UIDS = [0x11, 0x12, 0x21]


def hub() -> VirtualIhb:
    return VirtualIhb(wired(UIDS), uid=0xC0FFEE01, short_id=3)


def ask(
    ihb: VirtualIhb, command: int, payload: bytes = b"", to: int = 0xFF
) -> list[tuple[int, bytes]]:
    return ihb.answer(Packet(0.0, to, command, payload))


def test_discovery_tells_the_uid_and_takes_a_short_id() -> None:
    ihb = hub()
    assert ask(ihb, Command.DISCOVERY_PING) == [(0x10, bytes.fromhex("C0FFEE01"))]
    assert ask(ihb, Command.DISCOVERY_RECV_ID, bytes.fromhex("C0FFEE0105")) == [(0x11, b"")]
    assert ihb.short_id == 5
    assert ask(ihb, Command.DISCOVERY_RECV_ID, bytes.fromhex("0000000106")) == []
    assert ihb.short_id == 5


def test_declare_and_details_describe_the_modules() -> None:
    ihb = hub()
    assert ask(ihb, Command.DECLARE) == [(0x3C, bytes((2, 0, 3, 2)))]
    details = ask(ihb, Command.MODULE_DETAILS, b"\xff")
    assert [payload[:8].hex() for _, payload in details] == ["0000000001030000", "0100000002020000"]
    assert ask(ihb, Command.MODULE_DETAILS, b"\x01") == details[1:]


def test_auto_sync_sends_scans_at_the_period_and_stops() -> None:
    ihb = hub()
    assert not ihb.due(0.0)
    ask(ihb, Command.SET_AUTO_SYNC_PERIOD, b"\x00\x14")
    ask(ihb, Command.SET_AUTO_SYNC, b"\x01")
    sent = [ms for ms in range(100) if ihb.due(ms / 1000)]
    assert sent == [0, 20, 40, 60, 80]
    ask(ihb, Command.SET_AUTO_SYNC, b"\x00")
    assert not any(ihb.due(ms / 1000) for ms in range(100, 200))


def test_one_sync_sends_one_scan() -> None:
    ihb = hub()
    ask(ihb, Command.SYNC)
    assert [ihb.due(0.0), ihb.due(0.1)] == [True, False]


def test_a_late_caller_skips_scans_and_keeps_the_beat() -> None:
    ihb = hub()
    ask(ihb, Command.SET_AUTO_SYNC, b"\x01")
    assert [t for t in (0.0, 0.27, 0.28, 0.3, 0.34, 0.351) if ihb.due(t)] == [0.0, 0.27, 0.3, 0.351]


@pytest.mark.parametrize(
    ("command", "payload", "code"),
    [
        (0x99, b"", ErrorCode.NOT_SUPPORTED),
        (Command.MODULE_PHASE_SHIFT, b"\1", ErrorCode.NOT_SUPPORTED),
        (Command.SET_AUTO_SYNC, b"", ErrorCode.FORMAT),
        (Command.SET_AUTO_SYNC_PERIOD, b"\0", ErrorCode.FORMAT),
        (Command.SET_AUTO_SYNC_PERIOD, b"\0\0", ErrorCode.INVALID),
        (Command.MODULE_DETAILS, b"", ErrorCode.NO_ARGUMENT),
        (Command.MODULE_DETAILS, b"\x09", ErrorCode.INVALID),
        (Command.DISCOVERY_RECV_ID, b"\x01", ErrorCode.FORMAT),
    ],
)
def test_what_it_cannot_do_is_an_error_naming_the_command(
    command: int, payload: bytes, code: ErrorCode
) -> None:
    assert ask(hub(), command, payload) == [(Command.ERROR, bytes((command, code)))]


def test_requests_to_another_hub_are_not_answered() -> None:
    assert ask(hub(), Command.DECLARE, to=4) == []
    assert ask(hub(), Command.DECLARE, to=3) != []


def test_a_scan_of_the_wrong_size_is_a_programming_error() -> None:
    with pytest.raises(ValueError, match="4 counts for 5 channels"):
        list(hub().sensor_data([1, 2, 3, 4]))
