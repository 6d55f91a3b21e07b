"""A run on the fake clock, without waiting; deterministic for a scenario and a seed."""

from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path

import msgpack

from taxeld.commands.advise import Adviser
from taxeld.config import file as config_file
from taxeld.estimator.estimate import Estimate
from taxeld.skin.calibration import SkinState
from taxeld.source import recorder, session
from taxeld.source.session import Item
from taxeld.stream import topics
from taxeld_hil.grade.session import Run, add
from taxeld_hil.rig.ledger import Ledger
from taxeld_hil.rig.rig import lap, rigs_of
from taxeld_hil.run.fake import FakeDaemon, MemoryLine
from taxeld_hil.run.session_run import SessionRun, write_truth
from taxeld_hil.scenario import settings
from taxeld_hil.scenario.scenario import OF_FRAMES, Scenario
from taxeld_hil.world import subjects

NOT_INJECTED = ("subscriber_dead", "adapter_closed")  # there are no sockets, and no adapter
HEALTH_S = 1.0
BATCH = 1000  # records written at once


class FakeRun(SessionRun):
    """A scenario on the fake clock, tick by tick; or several, lap by lap, in one life."""

    def __init__(
        self,
        scenario: Scenario,
        seed: int,
        rate_hz: float = 100.0,
        filter_keys: str = "",
    ) -> None:
        """`rate_hz`: of the daemon's loop, and of all that steps with it; `filter_keys`: lines of
        TOML for the daemon's table [filter].

        Raises:
            SetupError: the scenario does not fit the skin, or there are faults in `filter_keys`.
        """
        self.scenario, self._seed = scenario, seed
        self.rigs = rigs_of(scenario, seed)
        self.rig = self.rigs[0]
        apart = [[rig] for rig in self.rigs]
        self.lines = [MemoryLine(*on) for on in ([self.rigs] if scenario.one_bus else apart)]
        self.line = self.lines[0]
        self.config_text = settings.without_devices(scenario, seed, filter_keys)
        parsed = config_file.parse(self.config_text)
        self.config = replace(parsed, loop=replace(parsed.loop, rate_hz=rate_hz))
        where = [rig.scenario.skin_layout for rig in self.rigs]
        self.scenes = [subjects.on_layout(name, *where) for name in scenario.known]
        self.skin = self.scenes[0].model.layout
        self._dead: FakeDaemon | None = None
        self.daemon: FakeDaemon | None = self._born()
        self._wire: WireFiles | None = None
        self._adviser = Adviser(self.config, settings.REACH) if scenario.advised else None
        self._began_s = self._next_health_s = 0.0

    def __exit__(self, *_: object) -> None:
        """Nothing runs beside it."""

    def lap(self, scenario: Scenario, seed: int) -> None:
        """Begin another scenario on the same skin, and have the daemon forget the object."""
        self._began_s = self.line.now + 1.0 / self.config.loop.rate_hz
        self._seed, self.scenario = seed, scenario
        lap(self.rigs, scenario, seed)
        if self.daemon is not None:
            self.daemon.pipeline.reset()

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

    def step(self, t: float) -> Estimate | None:
        """One tick of everything, at scenario time t; → the estimate of a daemon that is alive."""
        self._set(t)
        now = self.line.now
        self._kill_or_start(t)
        for line in self.lines:
            line.send_due()
            if self.daemon is None:
                line.take()
        for link, rig in enumerate(self.rigs):
            for row in rig.poses(t, now, now):
                if self._wire is not None:
                    self._wire.take(row, link)
                if self.daemon is not None:
                    rig.ledger.poses_heard += 1
                    self.daemon.pose(*row, link)
        if self.daemon is None:
            return None
        self.daemon.tick(now)
        e = self.daemon.estimate(now)
        if self._adviser and self.rig.wants_advice(of_t := t - (now - e.t)):
            self.rig.advise(self._adviser.advise(self.daemon.pipeline.estimator.memory), of_t, t)
        if self.published is not None:
            body = msgpack.packb(self.daemon.message(e, now))
            add(self.published, t, topics.ESTIMATE, body)
        if now >= self._next_health_s:
            self._next_health_s = now + HEALTH_S
            self._publish_health()
        return e

    def _publish_health(self) -> None:
        if self.daemon is not None and self.published is not None:
            body = msgpack.packb(self.daemon.health(self.line.now))
            add(self.published, self.line.t, topics.HEALTH, body)

    def _play(self, directory: Path) -> None:
        write_truth(directory, self.rig.world.truth)
        self._wire = WireFiles(directory, len(self.rigs))
        for link, line in enumerate(self.lines):
            line.record = partial(self._wire.take, link=link)
        self.run()
        self._wire.flush()

    def _about(self, name: str) -> Run:
        ledger = Ledger((), self.rig.ledger.period_s)
        for rig in self.rigs:
            ledger.add(rig.ledger)
        scenario = self.scenario
        taxels = [self.rigs[fault.link].taxels_of(fault) for fault in scenario.fault]
        not_injected = (*NOT_INJECTED, *(OF_FRAMES if self.rig.is_array else ()))
        about = name, self._seed, "sim", "fake", scenario, self.line.t
        return Run(*about, taxels, not_injected, ledger.entries())

    def _set(self, t: float) -> None:
        for line in self.lines:
            line.t, line.now = t, self._began_s + t

    def _kill_or_start(self, t: float) -> None:
        killed = self.rig.fails("daemon_killed", t)
        if killed and self.daemon is not None:
            self._dead, self.daemon = self.daemon, None
        elif not killed and self.daemon is None:
            for rig in self.rigs:
                rig.ledger.begin()
            self.daemon = self._born()

    def _born(self) -> FakeDaemon:
        """A daemon with what the one before has stored of the skin."""
        kept: list[SkinState | None] = [None] * len(self.rigs)
        if self._dead is not None:
            kept = [stage.skin.state() for stage in self._dead.pipeline.stages]
        return FakeDaemon(self.config, self.scenes, self.lines, kept)


class WireFiles:
    """The session's files of what skin and robot send, as a recorder writes them, without its
    thread."""

    def __init__(self, directory: Path, links: int) -> None:
        self._directory, self._links = directory, links
        self._waiting: list[tuple[Item, int]] = []
        self._written = Counter[str]()
        (directory / session.POSES).write_text(recorder.headers(links)[session.POSES])

    def take(self, item: Item, link: int) -> None:
        self._waiting.append((item, link))
        if len(self._waiting) >= BATCH:
            self.flush()

    def flush(self) -> None:
        """Write what has come."""
        parts = recorder.formatted(self._waiting, self._written, self._links)
        self._waiting = []
        for name, data in parts.items():
            path, header = self._directory / name, recorder.headers(self._links).get(name, "")
            if data:
                with path.open("ab") as file:
                    file.write((b"" if path.stat().st_size else header.encode()) + data)
