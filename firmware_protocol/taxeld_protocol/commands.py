"""CySkin's command table, both ways: the fields of each request and answer, and their bytes.

A payload is a map of named integers, big-endian. A command that a table does not list has no
payload, but for the versions' answers (text), DECLARE's answer and SENSOR_DATA (lists), and the
shorter answers of a hub whose modules are in their bootloader (`modules`).
"""

import struct
from collections.abc import Mapping

from taxeld_protocol.cyskin import Command

Fields = Mapping[str, int]


Table = Mapping[Command, tuple[str, tuple[str, ...]]]  # struct format and the fields' names

REQUESTS: Table = {
    Command.DISCOVERY_RECV_ID: (">IB", ("uid", "short_id")),
    Command.SET_AUTO_SYNC: (">B", ("on",)),
    Command.SET_AUTO_SYNC_PERIOD: (">H", ("period_ms",)),
    Command.MODULE_DETAILS: (">B", ("module",)),
    Command.MODULE_SET_CUT_SENSORS: (">BH", ("module", "cut")),  # bits that are set are cut
}
ANSWERS: Table = {
    Command.DISCOVERY_PING: (">I", ("uid",)),
    Command.ERROR: (">BB", ("failed", "error")),
    Command.UID: (">I", ("uid",)),
    Command.MODULE_DETAILS: (
        ">BIBBHBB",
        ("module", "sui", "channels", "grouping", "mask", "cdc_control", "cdc_speed"),
    ),
}


def request(command: Command, **fields: int) -> bytes:
    """The payload of a request.

    Raises:
        ValueError: a field is missing, unknown, or does not fit: a programming error.
    """
    return _encode(REQUESTS, command, fields)


def answer(command: Command, **fields: int) -> bytes:
    """The payload of an answer.

    Raises:
        ValueError: as for `request`.
    """
    return _encode(ANSWERS, command, fields)


def parse_request(command: int, payload: bytes) -> dict[str, int] | None:
    """The fields of a request; None if the payload is not the command's."""
    return _decode(REQUESTS, command, payload)


def parse_answer(command: int, payload: bytes) -> dict[str, int] | None:
    """The fields of an answer; None if the payload is not the command's."""
    return _decode(ANSWERS, command, payload)


def _encode(table: Table, command: Command, fields: Fields) -> bytes:
    layout, names = table.get(command, (">", ()))
    if fields.keys() != set(names):
        raise ValueError(f"{command.name} takes {', '.join(names) or 'nothing'}, not {fields}")
    try:
        return struct.pack(layout, *(fields[name] for name in names))
    except struct.error as error:
        raise ValueError(f"{command.name}: {error}, in {fields}") from None


def _decode(table: Table, command: int, payload: bytes) -> dict[str, int] | None:
    layout, names = table.get(command, (">", ()))  # type: ignore[call-overload]
    if len(payload) != struct.calcsize(layout):
        return None
    return dict(zip(names, struct.unpack(layout, payload), strict=True))
