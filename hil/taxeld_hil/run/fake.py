"""A run on the fake clock, without waiting; deterministic for a scenario and a seed.

The daemon is the one that ships, on a machine of memory. Its own process, its sockets and the
kernel's devices are not part of it: a run in real time has them.
"""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from taxeld.config import file as config_file
from taxeld.proposals import choice
from taxeld.service.loop import Daemon
from taxeld.source.recorder import Recorder
from taxeld.stream import topics
from taxeld_hil.grade.session import add
from taxeld_hil.rig.rig import rigs_of
from taxeld_hil.run.machine import Machine, MemoryLine
from taxeld_hil.run.session_run import SessionRun, write_truth
from taxeld_hil.scenario import settings
from taxeld_hil.scenario.scenario import OF_FRAMES, Scenario
from taxeld_sim.trials.guides import BeliefGuide
from taxeld_sim.world import subjects

REST_S = 0.12  # at the end, for what is on its way
NOWHERE = Path("/nowhere")  # where no file, socket and device is


class FakeRun(SessionRun):
    """A scenario on the fake clock."""

    clock = "fake"

    def __init__(self, scenario: Scenario, seed: int, rate_hz: float = 100.0) -> None:
        """`rate_hz`: of the daemon's loop, and of the steps of all around it.

        Raises:
            SetupError: the scenario does not fit the skin.
        """
        self.scenario, self.seed = scenario, seed
        self.rigs = rigs_of(scenario, seed)
        self.rig = self.rigs[0]
        # there is no adapter
        of_frames = OF_FRAMES if self.rig.is_array else ()
        self.not_injected = "adapter_closed", *of_frames
        devices = str(NOWHERE / "skin"), f"ipc://{NOWHERE}/poses", NOWHERE
        self._text = settings.text(scenario, seed, *devices)
        where = [rig.scenario.skin_layout for rig in self.rigs]
        self.scenes = [subjects.on_layout(name, *where) for name in scenario.known]
        self.skin = self.scenes[0].model.layout
        config = config_file.parse(self._text)
        first = choice.possible(self.scenes, config.filter)[0]  # whatever samples cost here
        self.config = replace(
            config,
            loop=replace(config.loop, rate_hz=rate_hz),
            publish=replace(config.publish, rate_hz=rate_hz),  # a pass at each step
            skin=replace(config.skin, state_dir=""),
            filter=replace(config.filter, proposal=first),
        )
        lines = {
            source.where: MemoryLine(*(self.rigs[k] for k in numbers))
            for source, numbers in config.buses
        }
        self.line = next(iter(lines.values()))
        self.machine = Machine(lines, 1.0 / rate_hz, self._publish)
        self.machine.bundles = lambda *_: self.scenes  # type: ignore[method-assign]
        self.daemon: Daemon | None = None  # the last
        self._recorder: Recorder | None = None
        self._ends: Callable[[], bool] = lambda: False
        self._is_over = False

    @property
    def duration_s(self) -> float:
        """So far: a robot that is advised goes on."""
        return max(rig.duration_s for rig in self.rigs)

    def run(self, ends: Callable[[], bool] = lambda: False) -> None:
        """To the end, or until `ends`, which is asked before each pass of a daemon."""
        self._ends = ends
        self._live()
        while not self._is_over:
            while self._is_killed:
                self.machine.sleep(1.0 / self.config.loop.rate_hz)
            for rig in self.rigs:
                rig.ledger.begin()
            for line in self.machine.lines.values():
                line.take()
                line.has_host = True
            self._live()

    def _live(self) -> None:
        """One life of a daemon."""
        self.daemon = daemon = Daemon(self.config, self._recorder, self.machine)
        advised, estimator = self.scenario.advised, daemon.pipeline.estimator
        guide = BeliefGuide("advised", estimator, self.seed) if advised else None
        daemon.run(lambda: self._is_to_end(daemon, guide))

    def _is_to_end(self, daemon: Daemon, guide: BeliefGuide | None) -> bool:
        machine, world = self.machine, self.rig.world
        now, is_killed = machine.now, self._is_killed
        more = world.touches < self.scenario.contacts
        if guide is not None and more and daemon.pipeline.estimate.t > world.duration_s:
            guide.lead(world, now)  # the belief has learned from the touch before
        if machine.is_sending and now >= self.duration_s:
            machine.is_sending, self.end_s = False, now
            for line in machine.lines.values():
                line.send_rest()
        is_all_told = not machine.is_sending and now >= self.end_s + REST_S
        self._is_over = self._ends() or is_all_told
        if self._is_over:
            daemon.publisher.health(daemon.health(now, machine.unix()), now)
        elif is_killed:
            self._keep()
        for line in machine.lines.values():
            line.has_host = not (self._is_over or is_killed)
        return self._is_over or is_killed

    @property
    def _is_killed(self) -> bool:
        return self.rig.fails("daemon_killed", self.machine.now)

    def _keep(self) -> None:
        """Leave the next daemon what is on the disk now, not what this one writes at its end."""
        if state := self.config.skin.state_dir:
            skin = replace(self.config.skin, state_dir=f"{state}+")
            shutil.copytree(state, skin.state_dir)
            self.config = replace(self.config, skin=skin)

    def _publish(self, topic: bytes, body: bytes) -> None:
        if self.published is not None and topic in (topics.ESTIMATE, topics.HEALTH):
            add(self.published, self.machine.now, topic, body)

    def _config(self, _: Path) -> str:
        return self._text

    def _play(self, directory: Path, place: Path) -> None:
        write_truth(directory, self.rig.world.truth)
        skin = replace(self.config.skin, state_dir=str(place / "state"))
        self.config = replace(self.config, skin=skin)
        with Recorder(directory, moves=True, worker=self.machine.worker) as self._recorder:
            self.run()
