"""Write icub_*.json, bring-ups of iCub skin boards, as README.md describes conversations.

Typed in from the protocol's description: nothing here comes from the code that is held against it.
"""

import json
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent

Line = dict[str, Any]

IDLE = [240] * 12
TAXELS = [0, 1, 2, 3, 4, 5, 7, 8, 9, 11]  # slots of the common triangle; 6 and 10 are thermal pads
PALM = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10]  # taxels of a palm's triangle; 11 is its thermal pad


def host(means: str, frame: str) -> Line:
    return {"from": "host", "frames": [frame], "means": means}


def answer(device: int, means: str, frame: str) -> Line:
    return {"from": "device", "device": device, "frames": [frame], "means": means}


def scan(
    device: int,
    board: int,
    triangles: dict[int, list[int]],
    taxels: dict[str, int],
    errors: dict[int, int] | None = None,
) -> Line:
    """A scan of a board: twelve values for each triangle that it sends."""
    frames, errors = [], errors or {}
    for triangle, values in triangles.items():
        head = "40" + bytes(values[:7]).hex().upper()
        tail = "C0" + bytes(values[7:]).hex().upper() + f"{errors.get(triangle, 0):04X}"
        frames += [f"4{board:X}{triangle:X}#{head}", f"4{board:X}{triangle:X}#{tail}"]
    line = {
        "from": "device",
        "device": device,
        "frames": frames,
        "means": "a scan" + (", some of it marked as failed" if errors else ""),
        "counts": [value for values in triangles.values() for value in values],
        "taxels": taxels,
    }
    return line | ({"errors": {str(k): word for k, word in errors.items()}} if errors else {})


def counts(sui: int, values: list[int], slots: list[int]) -> dict[str, int]:
    """What the host makes of a triangle: counts that rise with pressure, by UID."""
    return {str(sui << 4 | slot): 256 - values[slot] for slot in slots}


def uids(suis: list[int], slots: list[int]) -> list[int]:
    return [sui << 4 | slot for sui in suis for slot in slots]


RAMP = list(range(200, 212))
PRESSED = [240, 240, 240, 240, 240, 100, 0, 240, 240, 240, 255, 240]

CONVERSATIONS: dict[str, dict[str, Any]] = {
    "icub_power_up": {
        "about": "Two boards of one part, just powered: asked, set, given the triangles that have "
        "taxels, started. One taxel of the last scan did not acknowledge: the board says so of its "
        "triangle and marks the taxel, and the others are read.",
        "dialect": "icub",
        "host": {
            "period_ms": 50,
            "skin_type": 8,
            "boards": [9, 4],
            "taxels": uids([0, 1, 16 + 3], TAXELS),
        },
        "devices": [
            {"board": 9, "triangles": list(range(16)), "sends": False},
            {"board": 4, "triangles": list(range(16)), "sends": False},
        ],
        "script": [
            host("board 9, what are you", "209#1C0000"),
            host("board 4, what are you", "204#1C0000"),
            answer(0, "an MTB4, firmware 1.4.2", "290#1C0B010402010000"),
            answer(1, "an MTB4, firmware 1.4.2", "240#1C0B010402010000"),
            host("board 9: skin type 8, 50 ms, idle at 240; no triangle", "209#4D0832F0"),
            host("board 4: the same", "204#4D0832F0"),
            host("board 9: triangles 0 to 1, shift 2, on, offset 0x2200", "209#50000102010022"),
            host("board 4: triangle 3", "204#50030302010022"),
            host("board 9, start", "209#0700"),
            host("board 4, start", "204#0700"),
            scan(0, 9, {0: IDLE, 1: RAMP}, counts(0, IDLE, TAXELS) | counts(1, RAMP, TAXELS)),
            scan(1, 4, {3: PRESSED}, counts(16 + 3, PRESSED, TAXELS)),
            scan(
                0,
                9,
                {0: IDLE, 1: RAMP},
                counts(0, IDLE, [slot for slot in TAXELS if slot != 2]) | counts(1, RAMP, TAXELS),
                {0: 1 << 0 | 1 << 4 + 2},
            ),
        ],
    },
    "icub_sending": {
        "about": "A board that another host left sending all sixteen triangles. Setting it "
        "disables them at once, and nothing comes until triangles are enabled and it is started "
        "again. Those that have taxels are not in one row; they are of a palm, whose slots 6 and "
        "10 are taxels.",
        "dialect": "icub",
        "host": {"period_ms": 20, "skin_type": 0, "boards": [1], "taxels": uids([0, 8, 9], PALM)},
        "devices": [{"board": 1, "triangles": list(range(16)), "sends": True}],
        "script": [
            host("board 1, what are you", "201#1C0000"),
            answer(0, "an MTB4, firmware 1.4.2; it goes on sending", "210#1C0B010402010000"),
            scan(
                0,
                1,
                dict.fromkeys(range(16), IDLE),
                counts(0, IDLE, PALM) | counts(8, IDLE, PALM) | counts(9, IDLE, PALM),
            ),
            host("skin type 0, 20 ms, idle at 240; no triangle", "201#4D0014F0"),
            host("triangle 0, shift 2, on, offset 0x2200", "201#50000002010022"),
            host("triangles 8 to 9", "201#50080902010022"),
            host("start", "201#0700"),
            scan(
                0,
                1,
                {0: RAMP, 8: PRESSED, 9: IDLE},
                counts(0, RAMP, PALM) | counts(8, PRESSED, PALM) | counts(9, IDLE, PALM),
            ),
        ],
    },
}


def render(conversation: dict[str, Any]) -> str:
    """JSON with a line for each line of the script."""
    script = ",\n".join(f"  {json.dumps(line)}" for line in conversation["script"])
    rest = {key: value for key, value in conversation.items() if key != "script"}
    keys = "".join(f" {json.dumps(key)}: {json.dumps(value)},\n" for key, value in rest.items())
    return f'{{\n{keys} "script": [\n{script}\n ]\n}}\n'


if __name__ == "__main__":
    for name, conversation in CONVERSATIONS.items():
        (HERE / f"{name}.json").write_text(render(conversation), encoding="utf-8")
