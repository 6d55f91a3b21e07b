"""iCub skin through the daemon: bring-up, a CAN source, the layout, `taxeld decode`."""

import json
import os
import time
from dataclasses import replace
from pathlib import Path

import can
import numpy as np
import pytest

from taxeld.cli import main
from taxeld.config.file import parse
from taxeld.config.tables import SkinConfig, SourceConfig
from taxeld.config.toml_tables import ConfigError
from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld.skin.skin import Skin
from taxeld.source.sources import open_source
from taxeld_protocol import icub
from taxeld_protocol.decoder import MISSING, Scan
from taxeld_protocol.frames import Frame, format_log_line
from taxeld_protocol.icub import CHANNELS
from taxeld_protocol.modules import ABSENT_UID
from taxeld_protocol.virtual_icub import VirtualBoard
from tests.rig.commands import printed
from tests.rig.virtual_part import BOARDS, IDLE, SUIS, TICK_S, TRIANGLES, Boards, skin_layout

ROOT = Path(__file__).parents[2]
SHARED = Path(os.environ.get("TAXELD_SHARED", ROOT / ".." / "shared"))
POSITIONS = SHARED / "data" / "icub_positions"
MINIMAL = """
source = {{ kind = "{kind}", dialect = "icub", channel = "x"{more} }}
skin.full_scale_counts = {counts}
scene.bundle = "box"
publish.endpoints = ["ipc:///tmp/taxeld-icub-stream"]
control.endpoint = ""
"""


def settings(channel: str, **more: object) -> SourceConfig:
    return replace(
        SourceConfig(
            kind="can", dialect="icub", interface="virtual", channel=channel, boards=BOARDS
        ),
        **more,  # type: ignore[arg-type]
    )


class BoardsBus:
    """The boards' end of a python-can virtual bus, and the daemon's, on one clock."""

    def __init__(self, config: SourceConfig, boards: Boards, layout: Layout | None = None) -> None:
        self.boards = boards
        self.source = open_source(config, layout or skin_layout())
        self.bus = can.Bus(interface="virtual", channel=config.channel)

    def run(self, seconds: float) -> list[Scan]:
        """The scans that the daemon gets."""
        scans = []
        for _ in range(round(seconds / TICK_S)):
            self.boards.now_s += TICK_S
            scans += self.source.poll(self.boards.now_s)
            for frame in self.boards.tell(self.received()) + self.boards.scans():
                self.send(frame)
        return scans

    def felt(self) -> Skin:
        """A skin that has been captured at rest."""
        skin = Skin(skin_layout(), SkinConfig(full_scale_counts=200), baseline_scans=8)
        for scan in self.run(3.0):
            skin.on_scan(scan)
        return skin

    def received(self) -> list[Frame]:
        frames: list[Frame] = []
        while (message := self.bus.recv(0.0)) is not None:
            frames.append(Frame(0.0, message.arbitration_id, bytes(message.data)))
        return frames

    def send(self, frame: Frame) -> None:
        message = can.Message(
            arbitration_id=frame.can_id, data=frame.data, is_extended_id=frame.extended
        )
        self.bus.send(message)

    def close(self) -> None:
        self.source.close()
        self.boards.tell(self.received())
        self.bus.shutdown()


@pytest.mark.parametrize("sending", [False, True], ids=["after power-up", "while they send"])
def test_every_taxel_of_the_layout_is_heard_from_boards_that_behave_as_the_firmware_does(
    sending: bool,
) -> None:
    """Setting a board up disables its triangles: who does not enable them hears nothing."""
    boards = Boards(*BOARDS)
    for board in boards.boards.values():
        board.running = sending
    bus = BoardsBus(settings("all", period_ms=20), boards)
    heard = {uid for scan in bus.run(5.0) for module in scan.table for uid in module.uids}
    late = bus.run(1.0)
    assert all(board.period_ms == 20 for board in boards.boards.values())
    assert heard - {-1} >= set(skin_layout().uid.tolist())
    assert {(scan.ihb, count) for scan in late for count in scan.counts} == {(9, 16), (4, 16)}
    assert len(late) == pytest.approx(2 * 50, abs=4)
    bus.close()
    assert not any(board.running for board in boards.boards.values())


@pytest.mark.skipif(not POSITIONS.is_dir(), reason="iCub's positions are not beside this checkout")
@pytest.mark.parametrize("name", ["left_forearm_mesh", "right_leg_upper"])
def test_every_row_of_an_official_file_that_is_a_taxel_comes(name: str) -> None:
    skin = layouts.load(str(POSITIONS / f"{name}.txt"))
    boards = tuple(range(8, 8 + int(skin.uid.max()) // 256 + 1))
    bus = BoardsBus(settings(name, boards=boards), Boards(*boards), skin)
    heard: set[int] = set()
    for scan in bus.run(3.0):
        uids = [uid for module in scan.table for uid in module.uids]
        heard |= {uid for uid, count in zip(uids, scan.counts, strict=True) if count != MISSING}
    bus.close()
    assert heard - {ABSENT_UID} == set(skin.uid.tolist())


def test_boards_that_are_not_named_are_found_and_what_is_missing_is_said(
    caplog: pytest.LogCaptureFixture,
) -> None:
    boards = Boards(9)
    bus = BoardsBus(settings("found", boards=()), boards)
    assert bus.run(5.0) == []
    assert "board 9 answers, but cylinder" in bus.source.waits_for
    assert [record.getMessage() for record in caplog.records] == [bus.source.waits_for]
    boards.replace(4)
    scans = bus.run(4.0)
    assert {module.sui for scan in scans for module in scan.table} == set(SUIS)
    assert bus.source.waits_for == ""
    bus.close()


def test_a_touch_is_felt_by_the_taxel_that_the_layout_names() -> None:
    boards = Boards(*BOARDS)
    bus = BoardsBus(settings("touch"), boards)
    skin = bus.felt()
    touched = [IDLE] * CHANNELS
    touched[8] = 140
    touched[icub.THERMAL[0]] = 0
    boards.values[4, 3] = touched  # board 4's only triangle
    last = [skin.on_scan(scan) for scan in bus.run(0.2)][-1]
    assert last is not None
    assert skin.layout.uid[np.flatnonzero(last.z)].tolist() == [(16 + 3) << 4 | 8]
    assert last.z.max() == pytest.approx(100 / 200)
    assert last.live.all()
    bus.close()


def test_a_taxel_that_fails_does_not_blind_its_triangle() -> None:
    """The board says so of the whole triangle, and marks which it is."""
    boards = Boards(*BOARDS)
    bus = BoardsBus(settings("fails"), boards)
    skin = bus.felt()
    boards.errors[9] = {0: icub.NO_ACKNOWLEDGE | 1 << 4 + 2}
    boards.values[9, 0] = [IDLE] * 5 + [140] + [IDLE] * 6
    last = [skin.on_scan(scan) for scan in bus.run(1.0)][-1]
    assert last is not None
    assert skin.layout.uid[~last.live].tolist() == [0 << 4 | 2]
    assert skin.layout.uid[np.flatnonzero(last.z)].tolist() == [0 << 4 | 5]
    bus.close()


def test_a_listening_source_sends_nothing_and_counts_what_is_no_data_frame() -> None:
    boards = Boards(*BOARDS)
    bus = BoardsBus(settings("quiet", listen_only=True), boards)
    bus.bus.send(can.Message(arbitration_id=0x491, is_remote_frame=True, is_extended_id=False))
    for board in boards.boards.values():
        board.running = True
    assert {scan.ihb for scan in bus.run(0.2)} == {9, 4}
    stats = bus.source.wire.stats()
    bus.close()
    assert boards.sent == []
    assert stats["unknown"] == 1


def recorded(folder: Path, frames: list[Frame], boards: tuple[int, ...] = ()) -> SourceConfig:
    text = "\n".join(map(format_log_line, frames)) + "\n"
    (folder / "frames.log").write_text(text, encoding="ascii")
    return SourceConfig(kind="replay", dialect="icub", path=str(folder), boards=boards)


def scans_of(number: int) -> list[Frame]:
    board = VirtualBoard(number, TRIANGLES[number])
    return [f for k in range(3) for f in board.scan([IDLE] * len(board.triangles) * CHANNELS, t=k)]


def test_a_session_is_replayed_in_its_dialect(tmp_path: Path) -> None:
    source = open_source(recorded(tmp_path, scans_of(9), BOARDS), skin_layout())
    scans = [*source.poll(0.0), *source.poll(5.0)]
    assert [module.sui for module in scans[-1].table] == [0, 1]
    assert scans[-1].t > time.time() - 5.0


def test_a_session_without_named_boards_has_those_that_answered(tmp_path: Path) -> None:
    answers = [a for b in BOARDS for a in VirtualBoard(b).take(icub.to_frames(b, icub.ASK)[0])]
    source = open_source(recorded(tmp_path, answers + scans_of(4)), skin_layout())
    scans = [*source.poll(0.0), *source.poll(5.0)]
    assert [module.sui for module in scans[-1].table] == [3]  # the lower address is the first


@pytest.mark.parametrize(
    ("answering", "line"),
    [
        ((), r"^source\.boards: must name the 2 boards of cylinder.*: .* has no board's answer$"),
        ((9,), r"^source\.boards: board 9 answers, but cylinder.* of 2; name the part's, in"),
        ((9, 4, 5), r"^source\.boards: boards 4, 5, 9 answer, but cylinder.* of 2; name the"),
    ],
)
def test_a_session_whose_boards_nothing_tells_is_refused(
    tmp_path: Path, answering: tuple[int, ...], line: str
) -> None:
    answers = [a for b in answering for a in VirtualBoard(b).take(icub.to_frames(b, icub.ASK)[0])]
    with pytest.raises(SetupError, match=line):
        open_source(recorded(tmp_path, answers + scans_of(9)), skin_layout())


def test_a_listener_must_be_told_the_boards() -> None:
    with pytest.raises(
        SetupError, match=r"^source\.boards: must name the 2 boards of cylinder.*none is asked$"
    ):
        open_source(settings("told", boards=(), listen_only=True), skin_layout())


def test_a_layout_of_more_boards_than_are_named_is_one_line() -> None:
    with pytest.raises(
        SetupError, match=r"^source\.boards: names 1, but .* of 2; add the missing$"
    ):
        open_source(settings("few", boards=(9,)), skin_layout())


def test_a_layout_of_more_boards_than_a_bus_has_is_one_line() -> None:
    many = replace(skin_layout(), uid=np.arange(30) + (14 * 16 << 4))
    with pytest.raises(SetupError, match=r"^skin\.layout: .* of 15 boards, and a bus 14; name an"):
        open_source(settings("many"), many)


@pytest.mark.parametrize(
    ("kind", "more", "counts", "fault"),
    [
        ("serial", "", 200, "source.dialect: icub is spoken on CAN alone"),
        ("can", ", period_ms = 210", 200, "source.period_ms: must be 1..209 with dialect icub"),
        ("can", ", shift_bits = 16", 200, "source.shift_bits: must be 0..15, not 16"),
        (
            "can",
            ", offset_counts = 65536",
            200,
            "source.offset_counts: must be 0..65535, not 65536",
        ),
        ("can", ", no_load_counts = 256", 200, "source.no_load_counts: must be 0..255, not 256"),
        ("can", "", 20000, "skin.full_scale_counts: must be 1..255 with dialect icub"),
        ("can", ", boards = [1, 1]", 200, "source.boards: must be different boards of 1..14"),
        ("can", ", boards = [15]", 200, "source.boards: must be different boards of 1..14"),
        ("can", ", skin_type = 7", 200, "source.skin_type: must be one of 0, 1, 2, 3, 8, not 7"),
    ],
)
def test_what_the_dialect_cannot_do_is_a_fault(
    kind: str, more: str, counts: int, fault: str
) -> None:
    with pytest.raises(ConfigError) as error:
        parse(MINIMAL.format(kind=kind, more=more, counts=counts))
    (line,) = error.value.faults
    assert line.startswith(fault)


def test_a_good_icub_configuration_is_fine() -> None:
    config = parse(MINIMAL.format(kind="can", more=", boards = [9, 4]", counts=200))
    assert (config.source.boards, config.source.skin_type) == (BOARDS, 8)
    for skin_type in (0, 2, 3, 8):
        more = f", boards = [], skin_type = {skin_type}"
        assert parse(MINIMAL.format(kind="can", more=more, counts=200)).source.boards == ()


def test_the_configured_skin_type_reaches_the_boards() -> None:
    boards = Boards(*BOARDS)
    bus = BoardsBus(settings("type", skin_type=2), boards)
    bus.run(2.0)
    bus.close()
    assert [board.skin_type for board in boards.boards.values()] == [2, 2]


def test_check_says_that_boards_behind_ethernet_are_not_reached(tmp_path: Path) -> None:
    file = tmp_path / "icub.toml"
    bus = ', interface = "virtual"'
    file.write_text(MINIMAL.format(kind="can", more=bus, counts=200), encoding="utf-8")
    fine, note = printed("check", file).splitlines()
    assert fine == f"{file}: fine"
    assert note.startswith("note: source.channel: the boards must hang on x itself; behind an Eth")
    assert note.endswith("(EMS), as on most iCubs, they cannot be reached over CAN")


@pytest.mark.parametrize(
    ("more", "line"),
    [
        (", listen_only = true", "source.boards: must name the 1 boards of cylinder"),
        (", boards = [3], listen_only = true", ""),
    ],
)
def test_check_and_run_agree_on_who_must_be_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], more: str, line: str
) -> None:
    file = tmp_path / "icub.toml"
    bus = ', interface = "virtual"' + more
    file.write_text(MINIMAL.format(kind="can", more=bus, counts=200), encoding="utf-8")
    assert main(["check", str(file)]) == (2 if line else 0)
    assert capsys.readouterr().err.startswith(line)


def test_decode_reads_an_icub_log_and_counts_every_frame(tmp_path: Path) -> None:
    board = VirtualBoard(9, [0, 1])
    scans = [board.scan([200 + k] * 24, {1: 0x0010} if k else None, t=1.0 + k) for k in range(3)]
    lines = [format_log_line(frame) for frames in scans for frame in frames]
    lines += ["491#40", "491#AA", "18DAF110#0102", "not a frame"]
    log = tmp_path / "icub.log"
    log.write_text("\n".join(lines) + "\n", encoding="ascii")
    *read, last = map(json.loads, printed("decode", log, "--dialect", "icub").splitlines())
    assert read[-1] == {"t": 3.0, "ihb": 9, "modules": [[54] * 12, [None] + [54] * 11]}
    stats = last["stats"]
    promised = ("frames", "packets", "crc_errors", "length_errors", "index_errors", "unknown")
    assert [stats[key] for key in promised] == [15, 12, 0, 1, 0, 2]
    assert stats["scans"] == len(read)
    assert stats["dropped"] == {"foreign": 1, "mark": 1, "length": 1}
    assert stats["frames"] == stats["used"] + sum(stats["dropped"].values()) + stats["pending"]
    assert stats["bad_lines"] == 1
