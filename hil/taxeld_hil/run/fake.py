"""A daemon on a fake clock: its own source, bring-up, decoder and pipeline.

Its process, its sockets and the kernel's devices are not part of it: a run in real time has them.
"""

from collections.abc import Sequence
from typing import Any

from taxeld.config.tables import Config, SourceConfig
from taxeld.estimator.estimate import Estimate
from taxeld.layout.layout import Layout
from taxeld.pipeline.outcome import Outcome
from taxeld.pipeline.pipeline import Pipeline
from taxeld.proposals import several
from taxeld.proposals.bundle import Bundle
from taxeld.skin.calibration import Calibration
from taxeld.skin.state import SkinState
from taxeld.source import dialects
from taxeld.source.array_source import ArraySource
from taxeld.source.dialects import ToFrames
from taxeld.source.source import Source
from taxeld.source.sources import LiveSource
from taxeld.stream import messages
from taxeld_hil.run.memory import MemoryDevice, MemoryLine
from taxeld_protocol.array import ArrayFrame
from taxeld_protocol.cyskin import BROADCAST, Command


class FakeDaemon:
    """One life of a daemon."""

    def __init__(
        self,
        config: Config,
        skin: Layout,
        scenes: Sequence[Bundle],
        line: MemoryLine,
        kept: SkinState | None,
        calibration: Calibration | None = None,
    ) -> None:
        """`scenes`: of all objects that it knows; `kept`: what the life before has learned of the
        skin."""

        def device(_: SourceConfig, __: ToFrames) -> MemoryDevice:
            return MemoryDevice(line)

        samples = several.untimed(scenes, config.filter)
        model, *more = (scene.model for scene in scenes)
        self.pipeline = Pipeline(config, model, samples, calibration=calibration, more=more)
        self._line = line
        self.source: Source = (
            ArraySource(config.source, dialects.of_array(config.source, skin), None)
            if line.rig.is_array
            else LiveSource(config.source, dialects.live(config.source, skin), device, None)
        )
        if self.source.comes_by_door:
            line.ask(BROADCAST, bytes((Command.SET_AUTO_SYNC, 1)))  # as its subscription does
        self.scans = 0
        self.outcomes: list[Outcome] = []  # outcomes of the last tick
        self._start_s = line.now
        self.pipeline.freshness.came(self._start_s)
        if kept is not None:
            self.pipeline.skin.restore(kept)

    def pose(self, t: float, x: float, y: float, theta: float) -> None:
        self.pipeline.poses.add(t, x, y, theta)

    def tick(self, t: float) -> None:
        for frame in self._line.take() if self.source.comes_by_door else ():
            if isinstance(frame, ArrayFrame):
                self.source.hear(frame)
        scans = self.source.poll(t)
        self.scans += len(scans)
        self.outcomes = list(self.pipeline.advance(scans, t))
        for _ in self.outcomes:
            self.pipeline.freshness.came(t)

    def estimate(self, t: float) -> Estimate:
        """The estimate as it would be published now."""
        return self.pipeline.freshness.judged(self.pipeline.estimate, t)

    def health(self, t: float) -> dict[str, Any]:
        """The part of /taxeld/health that the harness reads."""
        parts = {
            "uptime_s": t - self._start_s,
            "loop": {"scans": self.scans},
            "source": self.source.wire.stats(),
            "inputs": {**self.pipeline.stages[0].counts(), "poses_malformed": 0},
            **self.pipeline.health(),
        }
        return messages.health(0, t, parts)
