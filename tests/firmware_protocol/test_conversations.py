"""Hubs of both languages and the daemon say what the conversations have, and nothing else."""

import runpy
import struct
import subprocess
from pathlib import Path

import pytest

from taxeld.config.tables import SourceConfig
from taxeld.source.sources import LiveSource
from taxeld_hil.rig.virtual_ihb import HubLink, Phase, VirtualIhb
from taxeld_protocol.frames import Frame, format_log_line
from taxeld_protocol.modules import listed
from tests.rig.conversations import FOLDER, NAMES, Conversation, hold_device, hold_host, load
from tests.rig.given_device import GivenDevice
from tests.rig.skins import SKIN
from tests.rig.virtual_hub import frames_of

from .c_side import SANITIZED, C, compile_c

PHASES = {"cold": Phase.BOOTLOADER, "warm": Phase.RUNNING}
each = pytest.mark.parametrize("name", NAMES)


def test_there_are_conversations_of_cold_warm_and_cut_hubs() -> None:
    assert {"cyskin_cold", "cyskin_warm", "cyskin_cut"} <= set(NAMES)


@each
def test_the_file_is_what_its_script_makes(name: str) -> None:
    script = runpy.run_path(str(FOLDER / "make.py"))
    assert (FOLDER / f"{name}.json").read_text(encoding="utf-8") == script["render"](name)


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
        return [] if request is None else frames_of(hub.answer(request), hub.short_id)

    def scan(counts: list[int]) -> list[Frame]:
        assert hub.due(0.0)
        return frames_of(hub.sensor_data(counts), hub.short_id)

    hold_device(conversation, hear, scan)


@each
def test_the_daemon_asks_what_the_host_does_and_reads_the_scan(name: str) -> None:
    conversation, device = load(name), GivenDevice()
    config = SourceConfig(kind="can", channel="x", period_ms=conversation.host["period_ms"])
    source = LiveSource(config, {0: SKIN}, lambda _: device)

    def step(now_s: float, heard: list[Frame]) -> tuple[list[Frame], dict[int, int]]:
        device.frames, device.sent = heard, []
        taxels = {
            uid: count
            for scan in source.poll(now_s)
            for uid, count in zip((u for m in scan.table for u in m.uids), scan.counts, strict=True)
        }
        return [frame._replace(t=0.0) for frame in device.sent], taxels

    hold_host(conversation, step)


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


@each
def test_the_hub_in_c_says_its_part(name: str, c_hub: Path, tmp_path: Path) -> None:
    text, script = text_of(load(name)), tmp_path / "script.txt"
    script.write_text(text, encoding="ascii")
    done = subprocess.run([c_hub, script], capture_output=True, text=True, check=False)
    assert (done.stderr, done.stdout) == ("", f"{text.count(chr(10))} lines\n")
