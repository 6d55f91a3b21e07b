"""Hubs of both languages say what the conversations have, and nothing else."""

import runpy
import struct
import subprocess
from pathlib import Path

import pytest

from taxeld_hil.rig.virtual_ihb import HubLink, Phase, VirtualIhb
from taxeld_protocol import cyskin
from taxeld_protocol.frames import Frame, format_log_line
from taxeld_protocol.modules import listed
from tests.rig.conversations import FOLDER, NAMES, Conversation, Line, hold_device, load

from .c_side import C, compile_c
from .test_c_side import SANITIZED, c_side  # noqa: F401  (a fixture)

PHASES = {"cold": Phase.BOOTLOADER, "warm": Phase.RUNNING}
each = pytest.mark.parametrize("name", NAMES)


def test_there_are_conversations_of_cold_warm_and_cut_hubs() -> None:
    assert {"cyskin_cold", "cyskin_warm", "cyskin_cut"} <= set(NAMES)


@each
def test_the_file_is_what_its_script_makes(name: str) -> None:
    script = runpy.run_path(str(FOLDER / "make.py"))
    assert (FOLDER / f"{name}.json").read_text(encoding="utf-8") == script["render"](name)


def frames(hub: VirtualIhb, answers: list[tuple[int, bytes]]) -> list[Frame]:
    return [f for answer in answers for f in cyskin.to_frames(*answer, ihb=hub.short_id)]


@each
def test_the_virtual_hub_says_its_part(name: str) -> None:
    conversation, link = load(name), HubLink()
    [entry] = conversation.devices
    hub = VirtualIhb(
        listed((module["sui"], module["mask"]) for module in entry["modules"]),
        uid=int(entry["uid"], 16),
        short_id=entry["short_id"],
        phase=PHASES[entry["state"]],
        # of these hubs all modules tell 12, or all what they send
        details_channels=12 if all(m["details_channels"] == 12 for m in entry["modules"]) else None,
        versions={},
    )

    def hear(frame: Frame) -> list[Frame]:
        request = link.feed(frame)
        return [] if request is None else frames(hub, hub.answer(request))

    def scan(line: Line) -> list[Frame]:
        assert line.counts is not None
        assert hub.due(0.0)
        return frames(hub, list(hub.sensor_data(line.counts)))

    hold_device(conversation, hear, scan)


def text_of(conversation: Conversation) -> str:
    """The conversation as the hub in C reads it."""

    def words(frames: list[Frame]) -> str:
        return " ".join(format_log_line(frame).split()[-1] for frame in frames)

    [entry] = conversation.devices
    modules = b"".join(
        struct.pack(">IHB", m["sui"], m["mask"], m["details_channels"]) for m in entry["modules"]
    )
    phase = PHASES[entry["state"]]
    lines = [f"hub {entry['uid']} {entry['short_id']:02X} {phase:d} {modules.hex()}"]
    for asked, answered in conversation.turns:
        lines.append("host " + words([frame for line in asked for frame in line.frames]))
        for line in answered:
            if line.counts is not None:
                lines.append(f"scan {struct.pack(f'>{len(line.counts)}H', *line.counts).hex()}")
            lines.append("device " + words(line.frames))
    return "\n".join(lines) + "\n"


@pytest.fixture(scope="module")
def c_hub(tmp_path_factory: pytest.TempPathFactory) -> Path:
    program = tmp_path_factory.mktemp("c") / "hub_main"
    compile_c(*SANITIZED, "-Wconversion", C / "hub_main.c", "-o", program)
    return program


def held(program: Path, place: Path, text: str) -> subprocess.CompletedProcess[str]:
    script = place / "script.txt"
    script.write_text(text, encoding="ascii")
    return subprocess.run([program, script], capture_output=True, text=True, check=False)


@each
def test_the_hub_in_c_says_its_part(name: str, c_hub: Path, tmp_path: Path) -> None:
    text = text_of(load(name))
    done = held(c_hub, tmp_path, text)
    assert done.stderr == ""
    assert done.stdout == f"{text.count(chr(10))} lines\n"
