"""The daemon's source asks what the conversations have, nothing else, and reads the scans."""

import pytest

from taxeld.config.tables import SkinConfig, SourceConfig
from taxeld.layout import read as layouts
from taxeld.source import dialects
from taxeld.source.device import Noticed
from taxeld.source.dialects import ToFrames
from taxeld.source.outbox import Unit
from taxeld.source.sources import LiveSource
from taxeld_protocol.frames import Frame
from tests.conversations import hold_host, load, names

SKIN = layouts.load(SkinConfig().layout)


class Bus:
    """A device whose other end is the conversation."""

    waits_for = ""

    def __init__(self, to_frames: ToFrames) -> None:
        self.noticed = Noticed()
        self._to_frames = to_frames
        self.heard: list[Frame] = []
        self.said: list[Frame] = []

    def fileno(self) -> int:
        return -1

    def read(self) -> list[Frame]:
        heard, self.heard = self.heard, []
        return heard

    def tend(self, now_s: float) -> None:
        """It needs nothing."""

    def pack(self, command: int, payload: bytes) -> list[Unit]:
        return [Unit(frame) for frame in self._to_frames(command, payload)]

    def put(self, unit: Unit) -> Unit | None:
        assert unit.frame is not None
        self.said.append(unit.frame)
        return None

    def close(self, wait_s: float = 0.0) -> None:
        """Nothing is held open."""


class DaemonSource:
    """As `tests.conversations.Host`."""

    def __init__(self, config: SourceConfig) -> None:
        dialect = dialects.live(config, SKIN)
        self.taxels: dict[int, int] = {}
        self._bus = Bus(dialect.to_frames)
        self._source = LiveSource(config, dialect, lambda *_: self._bus, None)

    def step(self, now_s: float, heard: list[Frame]) -> list[Frame]:
        self._bus.heard += heard
        for scan in self._source.poll(now_s):
            uids = [uid for module in scan.table for uid in module.uids]
            self.taxels = dict(zip(uids, scan.counts, strict=True))
        said, self._bus.said = self._bus.said, []
        return said


@pytest.mark.parametrize("name", names("cyskin"))
def test_the_daemon_says_its_part_and_reads_the_scan(name: str) -> None:
    conversation = load(name)
    period_ms = conversation.host["period_ms"]
    hold_host(
        conversation, DaemonSource(SourceConfig(kind="can", channel="x", period_ms=period_ms))
    )
