"""A part of an iCub for tests: its boards behind a bus, and the layout of its taxels."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain

import numpy as np

from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld_protocol import icub
from taxeld_protocol.frames import Frame
from taxeld_protocol.icub import CHANNELS
from taxeld_protocol.virtual_icub import VirtualBoard

BOARDS = (9, 4)
TRIANGLES = {9: [0, 1], 4: [3]}
SUIS = [0, 1, 16 + 3]  # those triangles, counted through the boards
TAXELS = [slot for slot in range(CHANNELS) if slot not in icub.THERMAL]
IDLE = 240
TICK_S = 0.01


def skin_layout() -> Layout:
    """Thirty taxels with the UIDs that the positions file of the two boards gives them."""
    generated = layouts.load("cylinder:rows=3,columns=10,radius_m=0.04,pitch_m=0.015")
    uid = np.array([sui << 4 | slot for sui in SUIS for slot in TAXELS])
    return replace(generated, uid=uid)


class Boards:
    """Boards on a bus, and a clock of their own."""

    def __init__(self, *numbers: int) -> None:
        self.boards = {number: VirtualBoard(number) for number in numbers}
        self.now_s = 0.0
        self.sent: list[tuple[float, int, bytes]] = []  # requests: when, to whom, what
        self.values: dict[tuple[int, int], list[int]] = {}  # of (board, triangle); idle where none
        self.errors: dict[int, dict[int, int]] = {}  # of a board: its triangles' error words

    def replace(self, number: int) -> None:
        """The board loses its power, and comes up again."""
        self.boards[number] = VirtualBoard(number)

    def tell(self, frames: Sequence[Frame]) -> list[Frame]:
        """What the boards answer to frames of the host."""
        for frame in frames:
            self.sent.append((self.now_s, frame.can_id & 0xF, frame.data))
        return [a for f in frames for board in self.boards.values() for a in board.take(f)]

    def scans(self) -> list[Frame]:
        """The frames that fall due now."""
        frames = []
        for board in self.boards.values():
            if board.due(self.now_s):
                keys = [(board.board, triangle) for triangle in board.triangles]
                values = [self.values.get(key, [IDLE] * CHANNELS) for key in keys]
                errors = self.errors.get(board.board)
                frames += board.scan(list(chain(*values)), errors, t=self.now_s)
        return frames
