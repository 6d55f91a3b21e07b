"""A daemon on a fake clock: its own source, bring-up, decoder and pipeline.

Its process, its sockets and the kernel's devices are not part of it: a run in real time has them.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from taxeld.config.tables import Config, SourceConfig
from taxeld.estimator.estimate import Estimate
from taxeld.layout.layout import Layout
from taxeld.pipeline.pipeline import Pipeline
from taxeld.proposals import bundle, choice
from taxeld.proposals.bundle import Bundle
from taxeld.skin.calibration import Calibration, SkinState
from taxeld.source.sources import ArraySource, LiveSource, Source, open_sources, polled
from taxeld.stream import messages
from taxeld_hil.run.memory import MemoryDevice, MemoryLine
from taxeld_protocol.array import ArrayFrame
from taxeld_protocol.cyskin import BROADCAST, Command


class FakeDaemon:
    """One life of a daemon."""

    def __init__(
        self,
        config: Config,
        scenes: Sequence[Bundle],
        lines: Sequence[MemoryLine],
        kept: Sequence[SkinState | None],
        calibration: Calibration | None = None,
    ) -> None:
        """`scenes`: of all objects that it knows; `lines`: one for each bus; `kept`: what the life
        before has learned of each link's skin.

        Raises:
            SetupError: links on one bus have the same modules, or more than it carries.
        """
        config = bundle.sized(config, [scene.manifest for scene in scenes])
        samples = choice.samples(scenes, config.filter)
        models = [scene.model for scene in scenes]
        skins = [link.layout for link in models[0].links]
        given = [calibration, *[None] * (len(skins) - 1)]
        self.pipeline = Pipeline(config, skins, models, samples, calibration=given)
        left = iter(lines)
        self.sources = open_sources(
            config, skins, lambda source, on_it: _source(source, on_it, next(left))
        )
        self._lines = lines
        self.source = self.sources[0]  # of the first link
        self._start_s = lines[0].now
        self.pipeline.freshness.came(self._start_s)
        for stage, state in zip(self.pipeline.stages, kept, strict=True):
            if state is not None:
                stage.skin.restore(state)

    def pose(self, t: float, x: float, y: float, theta: float, link: int = 0) -> None:
        self.pipeline.stages[link].poses.add(t, x, y, theta)

    def tick(self, t: float) -> None:
        for source, line in zip(self.sources, self._lines, strict=True):
            for frame in line.take() if source.comes_by_door else ():
                if isinstance(frame, ArrayFrame):
                    source.hear(frame)
        for outcome in self.pipeline.advance(polled(self.sources, t), t):
            self.pipeline.freshness.came(t, outcome.link)

    def estimate(self, t: float) -> Estimate:
        """The estimate as it would be published now."""
        return self.pipeline.estimate_at(t)

    def health(self, t: float) -> dict[str, Any]:
        """The part of /taxeld/health that the harness reads."""
        parts: dict[str, Any] = {
            "uptime_s": t - self._start_s,
            "source": self.source.decoder.stats(),
            **self.pipeline.health(),
        }
        parts["inputs"]["poses_malformed"] = 0
        if len(self.pipeline.stages) > 1:
            names, stages = self.pipeline.config.names, self.pipeline.stages
            parts["links"] = {
                name: stage.health() for name, stage in zip(names, stages, strict=True)
            }
            for source in self.sources:  # of links that share one, the first tells
                first = names[source.links.numbers[0]]
                parts["links"][first]["source"] = source.decoder.stats()
        return messages.health(0, t, parts)


def _source(config: SourceConfig, skins: Mapping[int, Layout], line: MemoryLine) -> Source:
    """The daemon's end of a line. Raises SetupError where the bus cannot carry the scans."""

    def device(_: SourceConfig) -> MemoryDevice:
        return MemoryDevice(line)

    if not line.rig.is_array:
        return LiveSource(config, skins, device)
    line.ask(BROADCAST, Command.SET_AUTO_SYNC, b"\1")  # as a subscription does
    return ArraySource(config, skins)
