"""The daemon's source asks what the conversations have, nothing else, and reads the scans."""

import pytest

from taxeld.config.tables import SourceConfig
from taxeld.source.sources import LiveSource
from taxeld_protocol.frames import Frame
from tests.rig.conversations import NAMES, hold_host, load
from tests.rig.given_device import GivenDevice
from tests.rig.skins import SKIN


class DaemonSource:
    """As `tests.rig.conversations.Host`."""

    def __init__(self, config: SourceConfig) -> None:
        self.taxels: dict[int, int] = {}
        self._bus = GivenDevice()
        self._source = LiveSource(config, {0: SKIN}, lambda _: self._bus)

    def step(self, now_s: float, heard: list[Frame]) -> list[Frame]:
        self._bus.frames += heard
        for scan in self._source.poll(now_s):
            uids = [uid for module in scan.table for uid in module.uids]
            self.taxels = dict(zip(uids, scan.counts, strict=True))
        said, self._bus.sent = self._bus.sent, []
        return [frame._replace(t=0.0) for frame in said]


@pytest.mark.parametrize("name", NAMES)
def test_the_daemon_says_its_part_and_reads_the_scan(name: str) -> None:
    conversation = load(name)
    period_ms = conversation.host["period_ms"]
    hold_host(
        conversation, DaemonSource(SourceConfig(kind="can", channel="x", period_ms=period_ms))
    )
