"""A run on a fake clock: the daemon's own source, bring-up, decoder and pipeline, in no time.

Deterministic for a scenario and a seed. What has no place here is the daemon's process, its sockets
and the host's kernel: those are for a run in real time.
"""

from dataclasses import asdict, replace
from typing import Any

from taxeld import bundle, dialects, layout, messages
from taxeld.bundle import Bundle
from taxeld.config import Config, SourceConfig
from taxeld.devices import LostError
from taxeld.dialects import ToFrames
from taxeld.errors import SetupError
from taxeld.estimate import Estimate, Status
from taxeld.layout import Layout
from taxeld.pipeline import Pipeline, is_valid
from taxeld.poses import PoseTrack
from taxeld.session import Chunk
from taxeld.skin_state import SkinState
from taxeld.sources import LiveSource
from taxeld_hil import settings
from taxeld_hil.grade import Grade, Run, grade
from taxeld_hil.judge import Judge, Sample
from taxeld_hil.reconcile import laws
from taxeld_hil.rig import Rig
from taxeld_hil.scenario import Scenario
from taxeld_protocol.cyskin import BROADCAST, Packet
from taxeld_protocol.frames import Frame

NOT_INJECTED = ("subscriber_dead",)  # there are no sockets
HEALTH_S = 1.0


class MemoryLine:
    """What a fake device is plugged into: the rig at the other end."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.t = 0.0  # scenario time,
        self.now = 0.0  # and the daemon's clock, which goes on over laps
        self._waiting: list[Frame] = []
        self._bytes = b""

    @property
    def is_plugged(self) -> bool:
        return not self.rig.fails("unplugged", self.t)

    def carry(self) -> None:
        """What the hub sends of itself at this time."""
        self._deliver(self.rig.scan(self.t, self.now))

    def rest(self) -> None:
        """And what was held back, at the end."""
        self._deliver(self.rig.rest())

    def ask(self, command: int, payload: bytes) -> None:
        self._deliver(self.rig.answer(Packet(self.now, BROADCAST, command, payload), self.t))

    def take(self) -> list[Frame] | list[Chunk]:
        """What waits for the host."""
        frames, data = self._waiting, self._bytes
        self._waiting, self._bytes = [], b""
        if self.rig.line:
            return [Chunk(self.now, data)] if data else []
        return frames

    def _deliver(self, units: list[Any]) -> None:
        self.rig.ledger.deliver_all(units, self.now)
        for unit in units:
            item = unit.item
            if isinstance(item, bytes):
                self._bytes += item
            else:  # what was late arrives now
                self._waiting.append(item if item.t == self.now else item._replace(t=self.now))


class MemoryDevice:
    """The daemon's end of it."""

    def __init__(self, line: MemoryLine) -> None:
        """Raises SetupError where it is not plugged in."""
        self.noise = self.foreign = 0
        self._line = line
        if not line.is_plugged:
            raise SetupError("unplugged")
        line.take()  # as a serial port is flushed when it is opened

    def read(self) -> list[Frame] | list[Chunk]:
        if not self._line.is_plugged:
            raise LostError
        return self._line.take()

    def write(self, command: int, payload: bytes) -> list[Frame]:
        self._line.ask(command, payload)
        return []

    def close(self) -> None:
        """Nothing is held open."""


class FakeDaemon:
    """One life of a daemon."""

    def __init__(
        self, config: Config, skin: Layout, scene: Bundle, line: MemoryLine, kept: SkinState | None
    ) -> None:
        """`kept`: what the life before has learned of the skin."""

        def device(_: SourceConfig, __: ToFrames) -> MemoryDevice:
            return MemoryDevice(line)

        self.config = config
        self.pipeline = Pipeline(config, skin, scene)
        self.source = LiveSource(config.source, dialects.live(config.source, skin), device, None)
        self.scans = 0
        self._last_scan_s = self._start_s = line.now
        if kept is not None:
            self.pipeline.skin.restore(kept)

    def pose(self, t: float, x: float, y: float, theta: float) -> None:
        if isinstance(self.pipeline.poses, PoseTrack):
            self.pipeline.poses.add(t, x, y, theta)

    def tick(self, t: float) -> None:
        scans = self.source.poll(t)
        self.scans += len(scans)
        for _ in self.pipeline.advance(scans, t):
            self._last_scan_s = t

    def estimate(self, t: float) -> Estimate:
        """As it would be published now."""
        estimate = self.pipeline.estimate
        if t - self._last_scan_s > self.config.loop.stale_s:
            return replace(estimate, status=Status.STALE)
        return estimate

    def health(self, t: float) -> dict[str, Any]:
        """What the harness reads of /taxeld/health."""
        parts = {
            "uptime_s": t - self._start_s,
            "loop": {"scans": self.scans},
            "source": {**self.source.wire.stats(), **asdict(self.source.counters)},
            "inputs": {**self.pipeline.input_counts(), "poses_malformed": 0},
            **self.pipeline.health(),
        }
        return messages.health(0, t, parts)


class FakeRun:
    """A scenario on the fake clock, tick by tick; or several, lap by lap, in one life."""

    def __init__(self, scenario: Scenario, seed: int, rate_hz: float = 100.0) -> None:
        """`rate_hz`: of the daemon's loop, and of all that steps with it."""
        self.rig = Rig(scenario, seed)
        self.line = MemoryLine(self.rig)
        self.config = settings.on_a_fake_clock(scenario, seed, rate_hz)
        self.skin = layout.load(scenario.layout)
        self.scene = bundle.load(scenario.bundle, self.skin, self.config.skin.full_scale_depth_m)
        self.daemon: FakeDaemon | None = self._born(None)
        self.judge = self._judging()
        self._seed = seed
        self._kept: SkinState | None = None
        self._began_s = self._next_health_s = 0.0

    def lap(self, scenario: Scenario, seed: int) -> None:
        """Begin another lap, and have the daemon forget the object."""
        self._began_s = self.line.now + 1.0 / self.config.loop.rate_hz
        self._seed = seed
        self.rig.lap(scenario, seed)
        self.judge = self._judging()
        if self.daemon is not None:
            self.daemon.pipeline.reset()

    def graded(self, name: str) -> Grade:
        """The scenario of this name to its end, and its grade."""
        self.run()
        held = laws(self.rig.ledger, self.judge.health or {}, line=self.rig.line, exact_times=True)
        run = Run(name, self._seed, "sim", "fake", self.rig.scenario.transport)
        return grade(run, self.judge, held, self.rig.ledger)

    def run(self) -> None:
        """To the end."""
        period = 1.0 / self.config.loop.rate_hz
        ticks = round(self.rig.duration_s / period)
        for k in range(ticks):
            self.step(k * period)
        self.line.rest()
        for k in range(ticks, ticks + 5):  # a scan may wait for its pose
            self._set(k * period)
            if self.daemon is not None:
                self.daemon.tick(self.line.now)
        if self.daemon is not None:
            self.judge.on_health(self.line.t, self.daemon.health(self.line.now))
        self.judge.end(self.line.t)

    def step(self, t: float) -> None:
        """One tick of everything, at scenario time t."""
        self._set(t)
        now, rig = self.line.now, self.rig
        self._kill_or_start(t)
        self.line.carry()
        if self.daemon is None:
            self.line.take()
        for row in rig.poses(t, now, now):
            if self.daemon is not None:
                rig.ledger.poses_heard += 1
                self.daemon.pose(*row)
        if self.daemon is None:
            return
        self.daemon.tick(now)
        e = self.daemon.estimate(now)
        self.judge.on_estimate(Sample(t, e.status, is_valid(e), e.contacts, e.map, e.t, now - e.t))
        if now >= self._next_health_s:
            self._next_health_s = now + HEALTH_S
            self.judge.on_health(t, self.daemon.health(now))

    def _set(self, t: float) -> None:
        self.line.t, self.line.now = t, self._began_s + t

    def _judging(self) -> Judge:
        rig = self.rig
        scene, truth = rig.model.scene, rig.world.truth
        return Judge(rig.scenario, scene, truth, NOT_INJECTED, rig.taxels_of)

    def _kill_or_start(self, t: float) -> None:
        killed = self.rig.fails("daemon_killed", t)
        if killed and self.daemon is not None:
            self._kept = self.daemon.pipeline.skin.state()  # stored when it was captured
            self.daemon = None
        elif not killed and self.daemon is None:
            self.rig.ledger.begin()
            self.daemon = self._born(self._kept)

    def _born(self, kept: SkinState | None) -> FakeDaemon:
        return FakeDaemon(self.config, self.skin, self.scene, self.line, kept)
