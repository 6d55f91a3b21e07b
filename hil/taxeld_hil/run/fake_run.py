"""A run on the fake clock, without waiting; deterministic for a scenario and a seed."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from taxeld.commands.advise import Adviser
from taxeld.config import file as config_file
from taxeld.estimator.estimate import Estimate
from taxeld.skin.calibration import Calibration, SkinState
from taxeld.source import recorder, session
from taxeld.source.session import Item
from taxeld_hil.grade.grade import Grade, Run, grade
from taxeld_hil.grade.judge import Judge, Sample
from taxeld_hil.grade.reconcile import laws, summed
from taxeld_hil.rig.bench import write_config, write_truth
from taxeld_hil.rig.ledger import Ledger
from taxeld_hil.rig.rig import lap, rigs_of
from taxeld_hil.run.fake import FakeDaemon
from taxeld_hil.run.memory import MemoryLine
from taxeld_hil.scenario import settings
from taxeld_hil.scenario.scenario import OF_FRAMES, Scenario
from taxeld_hil.world import bundled

NOT_INJECTED = ("subscriber_dead", "adapter_closed")  # there are no sockets, and no adapter
HEALTH_S = 1.0


class FakeRun:
    """A scenario on the fake clock, tick by tick; or several, lap by lap, in one life."""

    def __init__(
        self,
        scenario: Scenario,
        seed: int,
        rate_hz: float = 100.0,
        filter_keys: str = "",
        calibration: Calibration | None = None,
    ) -> None:
        """`rate_hz`: of the daemon's loop, and of all that steps with it; `filter_keys`: lines of
        TOML for the daemon's table [filter]; `calibration`: of this very skin.

        Raises:
            SetupError: the scenario does not fit the skin, or there are faults in `filter_keys`.
        """
        self.scenario = scenario
        self.rigs = rigs_of(scenario, seed)
        self.rig = self.rigs[0]
        apart = [[rig] for rig in self.rigs]
        self.lines = [MemoryLine(*on) for on in ([self.rigs] if scenario.one_bus else apart)]
        self.line = self.lines[0]
        self._file = settings.without_devices(scenario, seed, filter_keys)
        parsed = config_file.parse(self._file)
        self.config = replace(parsed, loop=replace(parsed.loop, rate_hz=rate_hz))
        where = [rig.scenario.skin_layout for rig in self.rigs]
        self.scenes = [bundled.on_layout(name, *where) for name in scenario.known]
        self.skin = self.scenes[0].model.layout
        self._calibration = calibration
        self._dead: FakeDaemon | None = None
        self.daemon: FakeDaemon | None = self._born()
        self.judge = self.judging()
        # called with what comes, and its link
        self._record: Callable[[Item, int], None] = lambda _item, _link: None
        self._adviser = Adviser(self.config, settings.REACH) if scenario.advised else None
        self._seed = seed
        self._began_s = self._next_health_s = 0.0

    def lap(self, scenario: Scenario, seed: int) -> None:
        """Begin another lap, and have the daemon forget the object."""
        self._began_s = self.line.now + 1.0 / self.config.loop.rate_hz
        self._seed, self.scenario = seed, scenario
        lap(self.rigs, scenario, seed)
        self.judge = self.judging()
        if self.daemon is not None:
            self.daemon.pipeline.reset()

    def graded(self, name: str, directory: Path | None = None) -> Grade:
        """The scenario of this name to its end, and its grade; its session into `directory`.

        Raises:
            SetupError: the directory has a session.
        """
        if directory is None:
            self.run()
        else:
            write_config(directory, self._file)
            write_truth(directory, self.rig)
            kept: list[tuple[Item, int]] = []
            self._record = lambda item, link: kept.append((item, link))
            for link, line in enumerate(self.lines):
                line.record = partial(self._record, link=link)
            self.run()
            write_session(directory, kept, len(self.rigs))
        ledger = self.rig.ledger
        if len(self.rigs) > 1:
            ledger = Ledger((), ledger.period_s)
            for rig in self.rigs:
                ledger.add(rig.ledger)
        counted = summed(self.judge.health or {})
        held = laws(ledger, counted, line=self.rig.line)
        run = Run(name, self._seed, "sim", "fake", self.scenario.transport)
        return grade(run, self.judge, held, ledger)

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
        if self.daemon is not None:
            self.judge.on_health(self.line.t, self.daemon.health(self.line.now))
        self.judge.end(self.line.t)

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
                self._record(row, link)
                if self.daemon is not None:
                    rig.ledger.poses_heard += 1
                    self.daemon.pose(*row, link)
        if self.daemon is None:
            return None
        self.daemon.tick(now)
        e = self.daemon.estimate(now)
        why = self.daemon.pipeline.freshness.why(e, now)
        if self._adviser and self.rig.wants_advice(of_t := t - (now - e.t)):
            self.rig.advise(self._adviser.advise(self.daemon.pipeline.estimator.memory), of_t, t)
        told = e.contacts, e.map, e.p, e.radius_m
        links = tuple(self.daemon.pipeline.freshness.of_links(now)) if len(self.rigs) > 1 else ()
        self.judge.on_estimate(
            Sample(t, e.status, why, *told, e.t, now - e.t, object=e.object, links=links)
        )
        if now >= self._next_health_s:
            self._next_health_s = now + HEALTH_S
            self.judge.on_health(t, self.daemon.health(now))
        return e

    def _set(self, t: float) -> None:
        for line in self.lines:
            line.t, line.now = t, self._began_s + t

    def judging(self) -> Judge:
        """A judge of what is estimated from now on, by where the object stands now."""
        rig = self.rig
        scene, truth = rig.model.scene, rig.world.truth
        not_injected = (*NOT_INJECTED, *(OF_FRAMES if rig.is_array else ()))
        rigs = self.rigs
        return Judge(self.scenario, scene, truth, not_injected, lambda f: rigs[f.link].taxels_of(f))

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
        return FakeDaemon(self.config, self.scenes, self.lines, kept, self._calibration)


def write_session(directory: Path, kept: Sequence[tuple[Item, int]], links: int) -> None:
    """Write the frames, or bytes of a serial line, and the poses of a run into its session."""
    parts, headers = recorder.formatted(kept, Counter(), links), recorder.headers(links)
    for name, data in parts.items():
        if data or name == session.POSES:
            (directory / name).write_bytes(headers.get(name, "").encode() + data)
