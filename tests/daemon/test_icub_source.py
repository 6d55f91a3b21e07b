"""iCub skin through the daemon: bring-up, a CAN source, the layout, `taxeld decode`."""

import json
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
from taxeld.source.icub_bring_up import IcubBringUp
from taxeld.source.sources import open_source
from taxeld_protocol import icub
from taxeld_protocol.frames import Frame, format_log_line
from taxeld_protocol.icub import CHANNELS
from taxeld_protocol.icub_decoder import IcubDecoder
from taxeld_protocol.virtual_icub import VirtualBoard

BOARDS = (9, 4)
TRIANGLES = {9: [0, 1], 4: [3]}
SUIS = [0, 1, 16 + 3]  # those triangles, counted through the boards
TAXELS = [slot for slot in range(CHANNELS) if slot not in icub.THERMAL]
IDLE = 240
MINIMAL = """
source = {{ kind = "{kind}", dialect = "icub", channel = "x"{more} }}
skin.full_scale_counts = {counts}
scene.bundle = "box"
"""


def skin_layout() -> Layout:
    """Thirty taxels with the UIDs that the positions file of the two boards gives them."""
    generated = layouts.load("cylinder:rows=3,columns=10,radius_m=0.04,pitch_m=0.015")
    uid = np.array([sui << 4 | slot for sui in SUIS for slot in TAXELS])
    return replace(generated, uid=uid)


def settings(channel: str, **more: object) -> SourceConfig:
    return replace(
        SourceConfig(
            kind="can", dialect="icub", interface="virtual", channel=channel, boards=BOARDS
        ),
        **more,  # type: ignore[arg-type]
    )


class Bus:
    """The boards' end of a python-can virtual bus."""

    def __init__(self, channel: str) -> None:
        self.bus = can.Bus(interface="virtual", channel=channel)
        self.boards = [VirtualBoard(board, TRIANGLES[board]) for board in BOARDS]

    def obey(self) -> list[Frame]:
        """Pass on the commands that have come."""
        frames: list[Frame] = []
        while (message := self.bus.recv(0.0)) is not None:
            frames.append(Frame(0.0, message.arbitration_id, bytes(message.data)))
        for frame in frames:
            for board in self.boards:
                board.take(frame)
        return frames

    def send(self, values: dict[int, list[int]]) -> None:
        for board in self.boards:
            for frame in board.scan(values[board.board]) if board.running else []:
                self.bus.send(
                    can.Message(arbitration_id=frame.can_id, data=frame.data, is_extended_id=False)
                )


def idle() -> dict[int, list[int]]:
    return {board: [IDLE] * CHANNELS * len(TRIANGLES[board]) for board in BOARDS}


def test_a_can_source_brings_the_boards_up_and_stops_them() -> None:
    source, bus = open_source(settings("up", period_ms=20), skin_layout()), Bus("up")
    source.poll(0.0)
    bus.obey()
    assert all(board.running and board.period_ms == 20 for board in bus.boards)
    for _ in range(3):
        bus.send(idle())
    scans = source.poll(0.01)
    assert {(scan.ihb, count) for scan in scans[-2:] for count in scan.counts} == {(9, 16), (4, 16)}
    source.close()
    bus.obey()
    assert not any(board.running for board in bus.boards)
    bus.bus.shutdown()


def test_a_touch_is_felt_by_the_taxel_that_the_layout_names() -> None:
    source, bus = open_source(settings("touch"), skin_layout()), Bus("touch")
    skin = Skin(skin_layout(), SkinConfig(full_scale_counts=200, baseline_scans=8))
    source.poll(0.0)
    bus.obey()
    touched = idle()
    touched[4][8] = 140  # board 4's only triangle, slot 8
    touched[4][icub.THERMAL[0]] = 0
    for values in [idle()] * 8 + [touched]:
        bus.send(values)
    activations = [skin.on_scan(scan) for scan in source.poll(0.01)]
    last = activations[-1]
    assert last is not None
    assert skin.layout.uid[np.flatnonzero(last.z)].tolist() == [(16 + 3) << 4 | 8]
    assert last.z.max() == pytest.approx(100 / 200)
    assert last.live.all()
    source.close()
    bus.bus.shutdown()


def test_a_listening_source_sends_nothing_and_counts_what_is_no_data_frame() -> None:
    source, bus = open_source(settings("quiet", listen_only=True), skin_layout()), Bus("quiet")
    bus.bus.send(can.Message(arbitration_id=0x491, is_remote_frame=True, is_extended_id=False))
    for board in bus.boards:
        board.running = True
    bus.send(idle())
    assert {scan.ihb for scan in source.poll(0.0)} == {9, 4}
    source.close()
    assert bus.obey() == []
    assert source.wire.stats()["unknown"] == 1
    bus.bus.shutdown()


def asked(
    bring_up: IcubBringUp, decoder: IcubDecoder, times_ms: range, *alive: VirtualBoard
) -> list[tuple[int, int]]:
    """(ms, board) of each start asked for while the boards in `alive` send all the time."""
    starts = []
    for ms in times_ms:
        for board in alive:
            for frame in board.scan([IDLE] * CHANNELS * len(board.triangles)):
                decoder.feed(frame)
        starts += [(ms, b) for b, command in bring_up.due(ms / 1000) if command == icub.START]
    return starts


def test_a_silent_board_is_asked_at_a_steady_low_rate_and_a_speaking_one_left_alone() -> None:
    one, two = VirtualBoard(9, [0]), VirtualBoard(4, [0])
    decoder = IcubDecoder(BOARDS)
    bring_up = IcubBringUp(decoder, BOARDS, 50)

    def run(start: int, stop: int, *alive: VirtualBoard) -> list[tuple[int, int]]:
        return asked(bring_up, decoder, range(start, stop, 10), *alive)

    assert run(0, 10) == [(0, 9), (0, 4)]
    assert run(10, 2000, one) == [(500, 4), (1000, 4), (1500, 4)]
    assert run(2000, 5000, one, two) == []
    assert run(5000, 6200, one) == [(5990, 4)]
    assert [board for board, _ in bring_up.stop()] == list(BOARDS)


def test_a_session_is_replayed_in_its_dialect(tmp_path: Path) -> None:
    board = VirtualBoard(9, TRIANGLES[9])
    frames = [f for k in range(3) for f in board.scan(idle()[9], t=float(k))]
    text = "\n".join(map(format_log_line, frames)) + "\n"
    (tmp_path / "frames.log").write_text(text, encoding="ascii")
    config = SourceConfig(kind="replay", dialect="icub", path=str(tmp_path), boards=BOARDS)
    source = open_source(config, skin_layout())
    scans = [*source.poll(0.0), *source.poll(5.0)]
    assert [module.sui for module in scans[-1].table] == [0, 1]
    assert scans[-1].t > time.time() - 5.0


def test_a_layout_of_more_boards_than_are_named_is_one_line() -> None:
    with pytest.raises(
        SetupError, match=r"^source\.boards: names 1, but .* of 2; add the missing$"
    ):
        open_source(settings("few", boards=(9,)), skin_layout())


@pytest.mark.parametrize(
    ("kind", "more", "counts", "fault"),
    [
        ("serial", "", 200, "source.dialect: icub is spoken on CAN alone"),
        ("can", ", period_ms = 256", 200, "source.period_ms: must be 1..255 with dialect icub"),
        ("can", "", 20000, "skin.full_scale_counts: must be 1..255 with dialect icub"),
        ("can", ", boards = [1, 1]", 200, "source.boards: must be different boards of 1..14"),
        ("can", ", boards = [15]", 200, "source.boards: must be different boards of 1..14"),
        ("can", ", boards = []", 200, "source.boards: must be different boards of 1..14"),
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
    assert config.source.boards == BOARDS


def test_decode_reads_an_icub_log_and_counts_every_frame(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    board = VirtualBoard(9, [0, 1])
    scans = [board.scan([200 + k] * 24, {1: 0x0010} if k else None, t=1.0 + k) for k in range(3)]
    lines = [format_log_line(frame) for frames in scans for frame in frames]
    lines += ["491#40", "491#AA", "18DAF110#0102", "not a frame"]
    log = tmp_path / "icub.log"
    log.write_text("\n".join(lines) + "\n", encoding="ascii")
    assert main(["decode", str(log), "--dialect", "icub"]) == 0
    *read, last = map(json.loads, capsys.readouterr().out.splitlines())
    assert read[-1] == {"t": 3.0, "ihb": 9, "modules": [[54] * 12, [None] + [54] * 11]}
    stats = last["stats"]
    promised = ("frames", "packets", "crc_errors", "length_errors", "index_errors", "unknown")
    assert [stats[key] for key in promised] == [15, 12, 0, 1, 0, 2]
    assert stats["scans"] == len(read)
    assert stats["dropped"] == {"foreign": 1, "mark": 1, "length": 1}
    assert stats["frames"] == stats["used"] + sum(stats["dropped"].values()) + stats["pending"]
    assert stats["bad_lines"] == 1
