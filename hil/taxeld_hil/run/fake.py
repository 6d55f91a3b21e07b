"""A run on the fake clock, without waiting; deterministic for a scenario and a seed.

The daemon is its own source, bring-up, decoder and pipeline. Its process, its sockets and the
kernel's devices are not part of it: a run in real time has them.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import msgpack

from taxeld.config import file as config_file
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
from taxeld.source.recorder import Recorder
from taxeld.source.session import Item, Pass, SensorPose
from taxeld.source.sources import ArraySource, LiveSource, Source, polled
from taxeld.stream import messages, topics
from taxeld_hil.grade.session import add
from taxeld_hil.rig.ledger import WireUnit
from taxeld_hil.rig.rig import Rig, rigs_of
from taxeld_hil.run.session_run import SessionRun, write_truth
from taxeld_hil.scenario import settings
from taxeld_hil.scenario.scenario import OF_FRAMES, Scenario
from taxeld_protocol.cyskin import BROADCAST, Command, Packet
from taxeld_protocol.frames import Chunk, Frame
from taxeld_sim.trials.guides import BeliefGuide
from taxeld_sim.world import subjects

HEALTH_S = 1.0
NOWHERE = Path("/nowhere")  # where no file, socket and device is


class MemoryLine:
    """The wire between the rigs on it and the fake devices that are plugged into it, one after the
    other."""

    def __init__(self, *rigs: Rig) -> None:
        self.rigs = rigs
        self.t = 0.0  # scenario time [s]
        self.now = 0.0  # the daemon's clock [s]
        self.record: Callable[[Item], None] = lambda _: None  # called with each delivered
        self._waiting: list[Any] = []  # frames, chunks or arrays

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
            return [Chunk(self.now, b"".join(chunk.data for chunk in came))]
        return came

    def _deliver(self, rig: Rig, units: list[WireUnit]) -> None:
        for unit in units:
            rig.ledger.deliver(unit, self.now)
            self._waiting.append(unit.at(self.now))  # a frame that was late arrives now
            self.record(self._waiting[-1])


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
            if isinstance(source, ArraySource):
                for frame in line.take():
                    source.hear(frame)
        for outcome in self.pipeline.advance(polled(self.sources, t), t):
            self.pipeline.freshness.came(t, outcome.link)

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


class FakeRun(SessionRun):
    """A scenario on the fake clock, tick by tick."""

    clock = "fake"

    def __init__(self, scenario: Scenario, seed: int, rate_hz: float = 100.0) -> None:
        """`rate_hz`: of the daemon's loop, and of all that steps with it.

        Raises:
            SetupError: the scenario does not fit the skin.
        """
        self.scenario, self.seed = scenario, seed
        self.rigs = rigs_of(scenario, seed)
        self.rig = self.rigs[0]
        # there is no adapter
        of_frames = OF_FRAMES if self.rig.is_array else ()
        self.not_injected = "adapter_closed", *of_frames
        apart = [[rig] for rig in self.rigs]
        self.lines = [MemoryLine(*on) for on in ([self.rigs] if scenario.one_bus else apart)]
        self.line = self.lines[0]
        devices = str(NOWHERE / "skin"), f"ipc://{NOWHERE}/poses", NOWHERE
        self._text = settings.text(scenario, seed, *devices)
        parsed = config_file.parse(self._text)
        self.config = replace(parsed, loop=replace(parsed.loop, rate_hz=rate_hz))
        where = [rig.scenario.skin_layout for rig in self.rigs]
        self.scenes = [subjects.on_layout(name, *where) for name in scenario.known]
        self.skin = self.scenes[0].model.layout
        self._kept: Sequence[SkinState | None] = [None] * len(self.rigs)
        self.daemon: FakeDaemon | None = self._born()
        self._recorder: Recorder | None = None
        self._next_health_s = 0.0

    def run(self) -> None:
        """To the end."""
        period = 1.0 / self.config.loop.rate_hz
        ticks = 0
        while ticks < round(self.duration_s / period):  # a robot that is advised goes on
            self.step(ticks * period)
            ticks += 1
        for line in self.lines:
            line.send_rest()
        for k in range(ticks, ticks + 5):  # a scan may wait for its pose
            self._set(k * period)
            if self.daemon is not None:
                self.daemon.tick(self.line.now)
        self._publish_health()

    @property
    def duration_s(self) -> float:
        """So far: a robot that is advised goes on."""
        return max(rig.duration_s for rig in self.rigs)

    def step(self, t: float) -> None:
        """One tick of everything, at scenario time t."""
        self._set(t)
        self._kill_or_start(t)
        for line in self.lines:
            line.send_due()
            if self.daemon is None:
                line.take()
        for link, rig in enumerate(self.rigs):
            for row in rig.poses(t, t, t):
                if self._recorder is not None:
                    self._recorder.take(SensorPose(*row), link, t)
                if self.daemon is not None:
                    rig.ledger.poses_heard += 1
                    self.daemon.pose(*row, link)
        if self._recorder is not None:
            self._recorder.take(Pass(t))
        if self.daemon is None:
            return
        self.daemon.tick(t)
        pipeline = self.daemon.pipeline
        e = pipeline.estimate_at(t)
        world, more = self.rig.world, self.rig.world.touches < self.scenario.contacts
        if self._guide is not None and more and e.t > world.duration_s:
            self._guide.lead(world, t)  # the belief has learned from the touch before
        if self.published is not None:
            add(self.published, t, topics.ESTIMATE, msgpack.packb(self.daemon.message(e, t)))
        if t >= self._next_health_s:
            self._next_health_s = t + HEALTH_S
            self._publish_health()

    def _publish_health(self) -> None:
        if self.daemon is not None and self.published is not None:
            body = msgpack.packb(self.daemon.health(self.line.now))
            add(self.published, self.line.t, topics.HEALTH, body)

    def _config(self, _: Path) -> str:
        return self._text

    def _play(self, directory: Path, _: Path) -> None:
        write_truth(directory, self.rig.world.truth)
        with Recorder(directory, moves=True) as self._recorder:
            for link, line in enumerate(self.lines):
                line.record = partial(self._recorder.take, link=link)
            self.run()
        self.end_s = self.line.t

    def _set(self, t: float) -> None:
        for line in self.lines:
            line.t = line.now = t

    def _kill_or_start(self, t: float) -> None:
        """A daemon that is started has what the one before has stored of the skin."""
        killed = self.rig.fails("daemon_killed", t)
        if killed and self.daemon is not None:
            self._kept = [stage.skin.state() for stage in self.daemon.pipeline.stages]
            self.daemon = None
        elif not killed and self.daemon is None:
            for rig in self.rigs:
                rig.ledger.begin()
            self.daemon = self._born()

    def _born(self) -> FakeDaemon:
        born = FakeDaemon(self.config, self.scenes, self.lines, self._kept)
        advised, estimator = self.scenario.advised, born.pipeline.estimator
        self._guide = BeliefGuide("advised", estimator, self.seed) if advised else None
        return born
