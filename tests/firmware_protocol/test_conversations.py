"""Hubs of both languages and the daemon say what the conversations have, and nothing else."""

import json
import re
import runpy
import shlex
import shutil
import signal
import struct
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from taxeld.commands.replay import RecordedInputs, open_pipeline
from taxeld.config.file import load as load_config
from taxeld.config.tables import SourceConfig
from taxeld.source import session
from taxeld.source.sources import LiveSource
from taxeld_hil.rig.virtual_ihb import HubLink, Phase, VirtualIhb
from taxeld_protocol import commands, cyskin
from taxeld_protocol.cyskin import BROADCAST, LEAVE_BOOTLOADER, Command, Packet
from taxeld_protocol.frames import Frame, format_log_line
from taxeld_protocol.modules import listed
from tests.pages import FENCED
from tests.rig.clocks import PATIENCE_S, until
from tests.rig.commands import printed
from tests.rig.conversations import FOLDER, NAMES, Conversation, hold_device, hold_host, load
from tests.rig.examples import examples
from tests.rig.given_device import GivenDevice
from tests.rig.processes import PIPES, taxeld
from tests.rig.skins import SKIN
from tests.rig.virtual_hub import frames_of

from .c_side import SANITIZED, C, CSide, compile_c
from .test_c_side import c_side  # noqa: F401  (a fixture)

PHASES = {"cold": Phase.BOOTLOADER, "warm": Phase.RUNNING}
each = pytest.mark.parametrize("name", NAMES)


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


UID = 0xC15C0001
MASKS = [0xFFF, 0x7FF, 0x7FE, 0x001, 0x000]
ASKED = [
    Command.DISCOVERY_PING,
    Command.DISCOVERY_RECV_ID,
    Command.ERROR,
    Command.MODULE_PROGRAM_END,
    Command.SET_AUTO_SYNC,
    Command.SET_AUTO_SYNC_PERIOD,
    Command.SET_COMM_SPEED,  # which neither does
    Command.DECLARE,
    Command.MODULE_DETAILS,
]
FIELDS = {
    "uid": st.sampled_from([UID, UID + 1]),
    "short_id": st.sampled_from([0, 1, 2, BROADCAST]),
    "on": st.sampled_from([0, 1, 2]),
    "period_ms": st.sampled_from([0, 1, 50, 0xFFFF]),
    "module": st.sampled_from([0, 1, len(MASKS) - 1, len(MASKS), 0xFF]),
}


@st.composite
def requests(draw: st.DrawFn) -> Packet:
    """Of a host; some of another length than theirs."""
    command = draw(st.sampled_from(ASKED))
    _, names = commands.REQUESTS.get(command, ("", ()))
    payload = commands.request(command, **{name: draw(FIELDS[name]) for name in names})
    if not draw(st.integers(0, 5)):
        payload = draw(st.binary(max_size=6))
    return Packet(0.0, draw(st.sampled_from([0, 1, 2, BROADCAST])), command, payload)


LEAVE = Packet(0.0, BROADCAST, LEAVE_BOOTLOADER, b"")


@given(st.sampled_from(Phase), st.lists(requests() | st.just(LEAVE), max_size=30))
@examples(150)
def test_a_hub_in_c_answers_whatever_it_is_asked_as_the_virtual_hub_does(
    c_side: CSide,  # noqa: F811
    phase: Phase,
    asked: list[Packet],
) -> None:
    virtual = VirtualIhb(listed(enumerate(MASKS)), uid=UID, phase=phase)
    modules = [{"sui": sui, "mask": mask, "channels": 12} for sui, mask in enumerate(MASKS)]
    hub = c_side.hub(UID, modules, phase)
    for packet in asked:
        want = [cyskin.encode(*answer) for answer in virtual.answer(packet)]
        if packet is LEAVE:
            hub.phase = virtual.phase
        else:
            assert c_side.answers(hub, packet) == want
        assert (hub.phase, hub.short_id) == (virtual.phase, virtual.short_id)
        assert (hub.auto_sync, hub.period_ms) == (virtual.auto_sync, virtual.period_ms)


PAGE = Path(__file__).parents[2] / "docs" / "own-skin.md"
SHOWN = dict(FENCED.findall(PAGE.read_text(encoding="utf-8")))  # language → its one block
CHANNELS = 11  # of each module: T0 to T10


def test_the_page_shows_what_is_the_boards_in_a_program_of_about_fifty_lines() -> None:
    program = (C / "own_skin.c").read_text(encoding="utf-8")
    assert SHOWN["c"] in program
    assert sum(1 for line in program.splitlines() if line.strip()) <= 60


@pytest.fixture
def own_skin(tmp_path: Path) -> Iterator[str]:
    """The device of the program, made by the page's command."""
    for name in ("taxeld_protocol.h", "own_skin.c", "own_skin_host.c"):
        shutil.copy(C / name, tmp_path)
    [command] = re.findall(r"`(cc .*?)`", PAGE.read_text(encoding="utf-8"))
    compile_c("-Wconversion", C / "own_skin.c", C / "own_skin_host.c", "-o", tmp_path / "strict")
    subprocess.run(shlex.split(command), cwd=tmp_path, check=True)
    with subprocess.Popen([tmp_path / "own_skin"], stdout=subprocess.PIPE, text=True) as program:
        yield program.stdout.readline().strip()
        program.kill()


@pytest.mark.check
def test_by_its_page_an_own_skin_is_recorded_without_a_wrong_value(
    tmp_path: Path, own_skin: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    file = json.loads(SHOWN["json"])
    [taxel] = file["skin"]["taxels"]
    assert taxel["id"] == SKIN.uid[0] == 1 << 4 | 1
    file["skin"]["taxels"] = [
        dict(zip(taxel, (int(uid), at.tolist(), normal.tolist()), strict=True))
        for uid, at, normal in zip(SKIN.uid, SKIN.position_m, SKIN.normal, strict=True)
    ]
    Path("skin.json").write_text(json.dumps(file), encoding="utf-8")
    layout, init, record, _accept = (
        shlex.split(line.replace("/dev/ttyACM0", own_skin)) for line in SHOWN["sh"].splitlines()
    )
    assert "80 in 8 modules" in printed(*layout[1:])
    assert "written: skin.toml" in printed(*init[1:])
    recording = Path("first", session.ARRIVALS)
    with taxeld(*record[1:], **PIPES) as process:
        until(lambda: recording.exists() and recording.stat().st_size > 4000)
        process.send_signal(signal.SIGINT)
        said, errors = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, errors) == (0, "")
    assert "0 sensor poses" in said
    inputs = RecordedInputs(
        Path("first"), open_pipeline(Path("first"), load_config(Path("skin.toml")))
    )
    for arrival in session.arrivals(Path("first")):
        inputs.take(arrival)
    scans, stats = inputs.scans(), inputs.sources[0].decoder.stats()
    first = scans[0].counts[0]
    assert len(scans) > 10
    for k, scan in enumerate(scans):
        at = 10_000 + (first - 10_000 + k) % 8
        assert scan.counts == tuple(range(at, at + 8 * CHANNELS))
        assert [module.channels for module in scan.table] == [CHANNELS] * 8
    assert (stats["bytes_dropped"], stats["incomplete"]) == (0, 0)
