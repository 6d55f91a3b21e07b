"""A daemon on a fake clock: its own source, bring-up, decoder and pipeline, and its wire.

Its process, its sockets and the kernel's devices are not part of it: a run in real time has them.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from typing import Any

from taxeld.config.tables import Config, SourceConfig
from taxeld.errors import SetupError
from taxeld.estimator.estimate import Estimate
from taxeld.layout.layout import Layout
from taxeld.pipeline.pipeline import Pipeline
from taxeld.proposals import bundle, choice
from taxeld.proposals.bundle import Bundle
from taxeld.skin.calibration import SkinState
from taxeld.source.device import Device, LostError
from taxeld.source.opening import open_sources
from taxeld.source.session import Item
from taxeld.source.sources import ArraySource, LiveSource, Source, polled
from taxeld.stream import messages
from taxeld_hil.rig.ledger import WireUnit
from taxeld_hil.rig.rig import Rig
from taxeld_protocol.array import ArrayFrame
from taxeld_protocol.cyskin import BROADCAST, Command, Packet
from taxeld_protocol.frames import Chunk, Frame


class MemoryLine:
    """The wire between the rigs on it and the fake devices that are plugged into it, one after the
    other."""

    def __init__(self, *rigs: Rig) -> None:
        self.rigs = rigs
        self.t = 0.0  # scenario time [s], which begins anew with each lap
        self.now = 0.0  # the daemon's clock [s], which goes on over laps
        self.record: Callable[[Item], None] = lambda _: None  # called with each delivered
        self._waiting: list[Any] = []  # frames, bytes or arrays

    @property
    def is_plugged(self) -> bool:
        return not any(rig.fails("unplugged", self.t) for rig in self.rigs)

    def send_due(self) -> None:
        """Deliver what the hubs send by themselves at this time."""
        for rig in self.rigs:
            self._deliver(rig, rig.scan(self.t, self.now))

    def send_rest(self) -> None:
        """Deliver what was held back, at the end."""
        for rig in self.rigs:
            self._deliver(rig, rig.rest())

    def ask(self, to: int, command: int, payload: bytes) -> None:
        """Deliver the answers to a request."""
        for rig in self.rigs:
            self._deliver(rig, rig.answer(Packet(self.now, to, command, payload), self.t))

    def take(self) -> list[Any]:
        """Frames, a chunk of bytes or arrays delivered since the last call."""
        came, self._waiting = self._waiting, []
        if came and self.rigs[0].line:
            return [Chunk(self.now, b"".join(came))]
        return came

    def _deliver(self, rig: Rig, units: list[WireUnit]) -> None:
        for unit in units:
            rig.ledger.deliver(unit, self.now)
            item = unit.item
            if isinstance(item, bytes):
                self._waiting.append(item)
                self.record(Chunk(self.now, item))
            else:
                item = item._replace(t=self.now)  # a frame that was late arrives now
                self._waiting.append(item)
                self.record(item)


class MemoryDevice(Device):
    """The daemon's end of the wire. It has no descriptor: nobody waits on a fake clock."""

    def __init__(self, line: MemoryLine) -> None:
        """Raises SetupError where it is not plugged in."""
        super().__init__()
        self._line = line
        if not line.is_plugged:
            raise SetupError("unplugged")
        line.take()  # as a serial port is flushed when it is opened

    def read(self) -> Sequence[Frame | Chunk]:
        if not self._line.is_plugged:
            raise LostError
        return self._line.take()

    def send(self, to: int, command: int, payload: bytes) -> None:
        self._line.ask(to, command, payload)

    def close(self, wait_s: float = 0.0) -> None:
        """Nothing is held open."""


class FakeDaemon:
    """One life of a daemon."""

    def __init__(
        self,
        config: Config,
        scenes: Sequence[Bundle],
        lines: Sequence[MemoryLine],
        kept: Sequence[SkinState | None],
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
        self.pipeline = Pipeline(config, skins, models, samples)
        left = iter(lines)
        self.sources = open_sources(
            config, skins, lambda source, on_it: _source(source, on_it, next(left)), ExitStack()
        )
        self._lines, self._start_s = lines, lines[0].now
        self._names = list(bundle.scenes(scenes))
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

    def message(self, e: Estimate, t: float) -> dict[str, Any]:
        """The message of that estimate."""
        fresh, age_us = self.pipeline.freshness, 1e6 * (t - e.t)
        why, links = fresh.why(e, t), fresh.of_links(t)
        return messages.estimate(e, names=self._names, seq=0, why=why, age_us=age_us, links=links)

    def health(self, t: float) -> dict[str, Any]:
        """The part of /taxeld/health that the harness reads."""
        counted = [source.decoder.stats() for source in self.sources]
        parts: dict[str, Any] = {"uptime_s": t - self._start_s, "source": counted[0]}
        parts |= self.pipeline.health()
        parts["inputs"]["poses_malformed"] = 0
        names, stages = self.pipeline.config.names, self.pipeline.stages
        if len(stages) > 1:
            links = {name: stage.health() for name, stage in zip(names, stages, strict=True)}
            for source, stats in zip(self.sources, counted, strict=True):
                # of links that share one, the first tells
                links[names[source.links.numbers[0]]]["source"] = stats
            parts["links"] = links
        return messages.health(0, t, parts)


def _source(config: SourceConfig, skins: Mapping[int, Layout], line: MemoryLine) -> Source:
    """The daemon's end of a line. Raises SetupError where the bus cannot carry the scans."""
    if not line.rigs[0].is_array:
        return LiveSource(config, skins, lambda _: MemoryDevice(line))
    line.ask(BROADCAST, Command.SET_AUTO_SYNC, b"\1")  # as a subscription does
    return ArraySource(config, skins)
