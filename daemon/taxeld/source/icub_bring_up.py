"""Bring-up of iCub skin boards: each silent board is given its period and started.

Pure: the time and the decoder's counts in, requests out. A request is the board's number and
the command to it. After the first request a board that sends is left alone, as configuring it makes
it calibrate itself anew: under a touch, that would hide the touch.
"""

import math
from collections.abc import Iterable, Sequence

from taxeld.source.bring_up import RETRY_S, SILENCE_S, Request
from taxeld_protocol import icub
from taxeld_protocol.cyskin import Packet
from taxeld_protocol.icub_decoder import IcubDecoder


class IcubBringUp:
    """Decides what to send to get scans and to keep them coming."""

    def __init__(self, decoder: IcubDecoder, boards: Sequence[int], period_ms: int) -> None:
        self._decoder = decoder
        self._setup = icub.set_board(period_ms)
        self._ask_s = dict.fromkeys(boards, -math.inf)  # when a board is asked, if it stays silent
        self._heard: dict[int, int] = {}  # halves of each board, when last looked

    def restart(self) -> None:
        """Begin again at once: the device was opened anew."""
        self._ask_s = dict.fromkeys(self._ask_s, -math.inf)

    @staticmethod
    def on_packet(_: Packet) -> list[Request]:
        """These boards send none."""
        return []

    @staticmethod
    def news() -> list[str]:
        """Nothing: what is silent shows in the counters."""
        return []

    def on_scan(self, ihb: int, now_s: float) -> None:
        """Not needed: `due` looks at what the decoder has had from each board."""

    def due(self, now_s: float) -> Iterable[Request]:
        """The requests to send now."""
        requests: list[Request] = []
        for board, ask_s in self._ask_s.items():
            heard = self._decoder.heard(board)
            if heard > self._heard.get(board, heard):
                self._ask_s[board] = now_s + SILENCE_S
            elif now_s >= ask_s:
                self._ask_s[board] = now_s + RETRY_S
                requests += [(board, self._setup), (board, icub.START)]
            self._heard[board] = heard
        return requests

    def stop(self) -> list[Request]:
        return [(board, icub.STOP) for board in self._ask_s]
