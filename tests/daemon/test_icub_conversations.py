"""The iCub conversations, against a board and against the host: who says what, frame by frame."""

import itertools
import json
import runpy
from dataclasses import replace
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from taxeld.config.tables import SourceConfig
from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld.source import icub_part
from taxeld.source.icub_bring_up import IcubBringUp
from taxeld_protocol import icub
from taxeld_protocol.decoder import MISSING
from taxeld_protocol.frames import Frame, format_log_line, parse_log_line
from taxeld_protocol.icub_decoder import IcubDecoder
from taxeld_protocol.virtual_icub import VirtualBoard

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "firmware_protocol" / "vectors" / "conversations"
FILES = sorted(FOLDER.glob("icub_*.json"))
TICK_S, PATIENCE_S = 0.01, 5.0

Line = dict[str, Any]
each = pytest.mark.parametrize(
    "talk", [json.loads(file.read_text()) for file in FILES], ids=[file.stem for file in FILES]
)


def frames_of(line: Line) -> list[Frame]:
    frames = [parse_log_line(text) for text in line["frames"]]
    return [frame for frame in frames if frame is not None]


def texts(frames: list[Frame]) -> list[str]:
    return [format_log_line(frame).split()[-1] for frame in frames]


def board_of(device: dict[str, Any]) -> VirtualBoard:
    board = VirtualBoard(device["board"], device["triangles"])
    board.running = board.configured = device["sends"]
    return board


def layout_of(taxels: list[int]) -> Layout:
    skin = layouts.read(f"cylinder:rows=1,columns={len(taxels)},radius_m=0.04,pitch_m=0.015")
    return replace(skin, uid=np.array(taxels))


def test_the_files_are_what_their_script_makes() -> None:
    script = runpy.run_path(str(FOLDER / "make_icub.py"))
    made = {name: script["render"](talk) for name, talk in script["CONVERSATIONS"].items()}
    assert {file.stem: file.read_text(encoding="utf-8") for file in FILES} == made


@each
def test_a_board_says_its_lines_and_nothing_else(talk: dict[str, Any]) -> None:
    boards = [board_of(device) for device in talk["devices"]]
    said: list[str] = []
    for speaker, lines in itertools.groupby(talk["script"], itemgetter("from")):
        for line in lines:
            if speaker == "host":
                said += texts([a for f in frames_of(line) for b in boards for a in tell(b, f)])
                continue
            if "counts" in line:
                board = boards[line["device"]]
                errors = {int(k): word for k, word in line.get("errors", {}).items()}
                assert board.running
                said += texts(board.scan(line["counts"], errors))
            assert said[: len(line["frames"])] == line["frames"]
            said = said[len(line["frames"]) :]
        if speaker == "device":
            assert said == []


def tell(board: VirtualBoard, frame: Frame) -> list[Frame]:
    answers = board.take(frame)
    if frame.can_id == icub.COMMAND | board.board and frame.data[0] == icub.SET_BOARD:
        assert board.scan([]) == []  # whether it sends or not, no triangle is left
    return answers


@each
def test_the_host_says_its_lines_and_makes_the_taxels_of_every_scan(talk: dict[str, Any]) -> None:
    asked = talk["host"]
    part = icub_part.of(layout_of(asked["taxels"]))
    decoder = IcubDecoder(asked["boards"], part.taxels)
    config = SourceConfig("can", period_ms=asked["period_ms"], skin_type=asked["skin_type"])
    bring_up = IcubBringUp(decoder, part, asked["boards"], config)
    now_s = 0.0
    said: list[str] = []
    for line in talk["script"]:
        if line["from"] == "host":
            end_s = now_s + PATIENCE_S
            while not said and now_s < end_s:
                now_s += TICK_S
                said = texts([f for r in bring_up.due(now_s) for f in icub.to_frames(*r)])
            assert said[: len(line["frames"])] == line["frames"]
            said = said[len(line["frames"]) :]
            continue
        assert said == []
        scans = [scan for frame in frames_of(line) for scan in decoder.feed(frame)[1]]
        if "taxels" in line:
            scans += decoder.flush()
            read = {
                str(uid): count
                for scan in scans
                for module, counts in zip(scan.table, scan.by_module, strict=True)
                for uid, count in zip(module.uids, counts, strict=True)
                if uid in asked["taxels"] and count not in (None, MISSING)
            }
            assert read == line["taxels"]
    assert said == []
    assert [r for tick in range(1, 20) for r in bring_up.due(now_s + tick * TICK_S)] == []
