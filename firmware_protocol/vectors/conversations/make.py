"""Write the CySkin conversations beside this file (see ../README.md).

Who says what, and after which pause, is typed in from the order that the vendor's library keeps to
and from the protocol's tables, not taken from this repository's host or hub: both are held against
it. Checksums and fragments alone are computed. The questions for versions are taxeld's own.
"""

import json
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parents[1]))  # the package beside this folder, installed or not

from taxeld_protocol import cyskin  # noqa: E402
from taxeld_protocol.cyskin import BROADCAST  # noqa: E402

Line = dict[str, Any]
Modules = list[tuple[int, int, int]]  # SUI, mask, channels that MODULE_DETAILS tells

UID = "C15C0001"
LEAVE: Line = {
    "from": "host",
    "frames": ["17FFFFFF#013B00004F6D17"],
    "means": "leave the bootloader",
}


def _frames(command: int, payload: str, short_id: int) -> list[str]:
    frames = cyskin.to_frames(command, bytes.fromhex(payload), ihb=short_id)
    return [f"{frame.can_id:03X}#{frame.data.hex().upper()}" for frame in frames]


def host(command: int, payload: str, means: str, after_ms: int = 0) -> Line:
    """A request, to all hubs, after a pause."""
    line = {"from": "host", "frames": _frames(command, payload, BROADCAST), "means": means}
    return line | ({"after_ms": after_ms} if after_ms else {})


def hub(command: int, payload: str, means: str, short_id: int = 1) -> Line:
    """An answer, from the hub that has the short id."""
    return {"from": "device", "frames": _frames(command, payload, short_id), "means": means}


def scan(names: Iterable[tuple[int, int]], first: int = 10_000) -> Line:
    """A scan whose channels, of these (SUI, name), read numbers that rise by one; one packet."""
    uids = [sui << 4 | name for sui, name in names]
    counts = [first + k for k in range(len(uids))]
    payload = "0000" + "".join(f"{count:04X}" for count in counts)
    return hub(0x43, payload, "a scan") | {
        "counts": counts,
        "taxels": {str(uid): count for uid, count in zip(uids, counts, strict=True)},
    }


def named(short_id: int) -> list[Line]:
    """Discovery of a hub that has that short id, and is given 1."""
    return [
        hub(0x10, UID, f"I am {UID}", short_id),
        host(0x11, f"{UID}01", f"{UID}, your short id is 1"),
        hub(0x11, "", "it is"),
    ]


FIND = [LEAVE, host(0x10, "", "discovery: who is there?", after_ms=100)]
ASK = [
    host(0x3C, "", "how many channels does each module send?"),
    host(0x3D, "FF", "details of all modules"),
]
START = [
    host(0x37, "00", "auto sync off"),
    host(0x31, "", "modules, start your application", after_ms=60),
    host(0x10, "", "discovery: who is there?", after_ms=500),
]
VERSIONS = [
    host(0x3E, "", "your version?"),
    hub(0x13, "3EE2", "that is not supported"),
    host(0x3F, "", "the version of your modules' bootloader?"),
    hub(0x13, "3FE2", "that is not supported"),
    host(0x40, "", "the version of your modules' application?"),
    hub(0x13, "40E2", "that is not supported"),
]
STREAM = [*VERSIONS, host(0x38, "0032", "a scan every 50 ms"), host(0x37, "01", "auto sync on")]

COLD = [
    *FIND,
    *named(9),
    *ASK,
    hub(0x3C, "02", "I have two modules, which are in their bootloader"),
    hub(0x3D, "0000000DCF", "module 0 is 3535"),
    hub(0x3D, "0100000DCE", "module 1 is 3534"),
    *START,
    *named(1),
    *ASK,
    hub(0x3C, "02000B0B", "two modules send eleven channels each"),
    hub(0x3D, "0000000DCF0C0007FF0000", "module 0 is 3535: T0 to T10, twelve possible"),
    hub(0x3D, "0100000DCE0C0007FF0000", "module 1 is 3534: T0 to T10, twelve possible"),
    *STREAM,
    scan((sui, name) for sui in (3535, 3534) for name in range(11)),
]

RUNNING = [
    hub(0x3C, "02000C0B", "two modules send twelve channels and eleven"),
    hub(0x3D, "0000000DCF0C000FFF0000", "module 0 is 3535: T0 to T11"),
    hub(0x3D, "0100000DCE0B0007FF0000", "module 1 is 3534: T0 to T10"),
]
WARM = [
    *FIND,
    *named(1),
    *ASK,
    *RUNNING,
    *START,
    *named(1),
    *ASK,
    *RUNNING,
    *STREAM,
    scan([*((3535, name) for name in range(12)), *((3534, name) for name in range(11))]),
]

CUT = [
    *FIND,
    *named(1),
    *ASK,
    hub(0x3C, "03", "I have three modules, which are in their bootloader"),
    hub(0x3D, "0000000DD0", "module 0 is 3536"),
    hub(0x3D, "0100000DC6", "module 1 is 3526"),
    hub(0x3D, "0200000DD1", "module 2 is 3537"),
    *START,
    *named(1),
    *ASK,
    hub(0x3C, "03000C080C", "three modules send twelve channels, eight and twelve"),
    hub(0x3D, "0000000DD00C000FFF0000", "module 0 is 3536: T0 to T11"),
    hub(0x3D, "0100000DC60C00076D0000", "module 1 is 3526: T1, T4, T7 and T11 are cut"),
    hub(0x3D, "0200000DD10C000FFF0000", "module 2 is 3537: T0 to T11"),
    *STREAM,
    scan(
        [
            *((3536, name) for name in range(12)),
            *((3526, name) for name in (0, 2, 3, 5, 6, 8, 9, 10)),
            *((3537, name) for name in range(12)),
        ]
    ),
]


def conversation(
    about: str, state: str, short_id: int, modules: Modules, script: list[Line]
) -> dict[str, Any]:
    """A file's content; of its one hub, the state before the first line."""
    told = [
        {"sui": sui, "mask": mask, "details_channels": channels} for sui, mask, channels in modules
    ]
    device = {"uid": UID, "short_id": short_id, "state": state, "modules": told}
    return {
        "about": about,
        "host": {"period_ms": 50},
        "devices": [device],
        "script": script,
    }


CONVERSATIONS = {
    "cyskin_cold": conversation(
        "A hub that was just powered, with a short id of its own: it and its modules are led out "
        "of their bootloaders. DETAILS tell twelve channels of modules that send eleven.",
        "cold", 9, [(3535, 0x7FF, 12), (3534, 0x7FF, 12)], COLD,
    ),
    "cyskin_warm": conversation(
        "A hub whose modules run already. What leads others out of their bootloaders does it no "
        "harm. DETAILS tell as many channels as are sent.",
        "warm", 1, [(3535, 0xFFF, 12), (3534, 0x7FF, 11)], WARM,
    ),
    "cyskin_cut": conversation(
        "A cut module between two whole ones: it sends eight channels, though DETAILS tell twelve, "
        "and what comes after it stands where it belongs.",
        "cold", 1, [(3536, 0xFFF, 12), (3526, 0x76D, 12), (3537, 0xFFF, 12)], CUT,
    ),
}  # fmt: skip


def render(name: str) -> str:
    """A file's text: a line of it a line of the conversation."""
    value = CONVERSATIONS[name]
    head = [f"{json.dumps(key)}: {json.dumps(value[key])}" for key in value if key != "script"]
    lines = ",\n".join(json.dumps(line) for line in value["script"])
    return "{\n" + ",\n".join([*head, f'"script": [\n{lines}\n]']) + "\n}\n"


if __name__ == "__main__":
    for file in CONVERSATIONS:
        (HERE / f"{file}.json").write_text(render(file), encoding="utf-8")
