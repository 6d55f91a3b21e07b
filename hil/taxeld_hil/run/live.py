"""A run in real time: the daemon as a process of its own, fed by a virtual skin or by hardware, and
its messages graded as they come."""

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import zmq

from taxeld.errors import SetupError
from taxeld_hil.grade.grade import Grade, Run, grade
from taxeld_hil.grade.judge import Judge
from taxeld_hil.grade.reconcile import Law, laws
from taxeld_hil.rig.bench import Bench, recorded, write_config
from taxeld_hil.rig.rig import Rig
from taxeld_hil.run.advice import REST_S, AdviceThread
from taxeld_hil.run.contact_table import HEADER, OBJECT, ContactTable
from taxeld_hil.run.listener import Listener, Say, socket
from taxeld_hil.run.processes import Processes
from taxeld_hil.scenario import settings
from taxeld_hil.scenario.scenario import OF_FRAMES, Scenario

START_S = 60.0  # until the first estimate; a busy machine has taken 20 s
STEP_MS = 2
COUNTED_S = 20.0  # at most, until the daemon has counted all that it was sent
DRAIN_S = 0.2
QUIET = '[log]\nlevel = "error"\n'  # the daemon warns of injected faults, which are in the ledger
NOT_INJECTED = {  # transport → kinds of faults
    "can": ("unplugged", "adapter_closed"),  # something else brings the interface up and down
    "native": ("adapter_closed",),
    "array": OF_FRAMES,
}


class LiveRun:
    """A scenario on a virtual skin over a real transport; or several, lap by lap, on one daemon."""

    def __init__(
        self, name: str, scenario: Scenario, seed: int, directory: Path, channel: str, say: Say
    ) -> None:
        """`directory` gets the session; `channel`: a CAN interface, unused on other transports;
        `say` prints a line."""
        self.run = Run(name, seed, "sim", "real", scenario.transport)
        self.scenario = scenario.one_link()
        self._directory = directory
        self._channel = channel
        self._say = say

    def graded(self, place: Path) -> Grade:
        """To the end; sockets and links are made in `place`.

        Raises:
            SetupError: a process failed, or the interface is not there.
        """
        with self.opened(place) as bench:
            self._say(HEADER + OBJECT * (len(self.scenario.known) > 1))
            self._serve(bench)
            held = self.settled(bench)
        judge, table = self._listener.judge, self._listener.table
        judge.end(bench.rig.duration_s)
        for line in table.latencies():
            self._say(line)
        self._say(table.final())
        if self.scenario.advised:
            self._say(f"advised: {len(bench.rig.path.touched)} approaches, {table.sure()}")
        return grade(self.run, judge, held, bench.rig.ledger)

    def lap(self, bench: Bench, name: str, scenario: Scenario, seed: int) -> Grade:
        """Another scenario on the same daemon, which forgets the object. Nothing is printed, and
        the accounts are left to `settled`, after the last lap.

        Raises:
            SetupError: a process failed.
        """
        if bench.start_s is not None:
            self._reset(bench)
        bench.lap(scenario, seed)
        judge = self._listener.judge = self._judging(bench.rig)
        self._listener.table = self._table(bench.rig)
        self._serve(bench)
        judge.end(bench.rig.duration_s)
        return grade(replace(self.run, scenario=name), judge, [], bench.rig.ledger)

    @contextmanager
    def opened(self, place: Path) -> Iterator[Bench]:
        """The bench while everything runs; all processes are stopped in the end."""
        scenario, rig = self.scenario, Rig(self.scenario, self.run.seed)
        where: Path | str = self._channel if scenario.transport == "can" else place / "skin"
        config = settings.text(scenario, self.run.seed, str(where), f"ipc://{place}/poses", place)
        written = write_config(self._directory, config + QUIET)
        self._place = place
        with ExitStack() as stack:
            context = stack.enter_context(zmq.Context())
            poses = socket(stack, context, zmq.XPUB)
            poses.bind(f"ipc://{place}/poses")
            bench = stack.enter_context(recorded(rig, where, poses, self._directory))
            stream = f"ipc://{place}/stream"
            self._listener = Listener(
                stack, context, stream, self._judging(rig), self._table(rig), self._say
            )
            self._advice = AdviceThread(written) if scenario.advised else None
            self.processes = Processes(written, stream, scenario)
            stack.callback(self.processes.kill)
            self.processes.start()
            yield bench
            self.processes.stop()

    def settled(self, bench: Bench) -> list[Law]:
        """The laws of the accounts, once they hold, or after COUNTED_S."""
        listener, rig = self._listener, bench.rig
        bench.finish()
        listener.finish()
        deadline = time.monotonic() + COUNTED_S
        while True:
            held = laws(rig.ledger, listener.judge.health or {}, line=rig.line)
            if all(law.holds for law in held) or time.monotonic() > deadline:
                return held
            listener.wait(STEP_MS)
            bench.step()
            listener.receive(bench.t)

    def _reset(self, bench: Bench) -> None:
        """Have the daemon forget the object, and discard what it has published of it."""
        self.processes.reset(f"ipc://{self._place}/control")
        until = time.monotonic() + DRAIN_S
        while time.monotonic() < until:
            self._listener.wait(STEP_MS)
            bench.step()
            self._listener.drop()

    def _judging(self, rig: Rig) -> Judge:
        not_injected = NOT_INJECTED.get(rig.scenario.transport, ())
        scene, truth = rig.model.scene, rig.world.truth
        return Judge(rig.scenario, scene, truth, not_injected, rig.taxels_of)

    @staticmethod
    def _table(rig: Rig) -> ContactTable:
        return ContactTable(rig.model.scene, rig.world.truth)

    def _serve(self, bench: Bench) -> None:
        began = time.monotonic()
        while bench.t < bench.rig.duration_s:
            self._listener.wait(STEP_MS)
            bench.step()
            self._listener.receive(bench.t)
            if self._advice is not None and bench.rig.wants_advice(bench.t - REST_S):
                self._advise(self._advice, bench)
            self._supervise(bench)
            if bench.start_s is None and time.monotonic() - began > START_S:
                raise SetupError(f"the daemon did not start the skin within {START_S:g} s")

    @staticmethod
    def _advise(thread: AdviceThread, bench: Bench) -> None:
        """Have the robot follow advice on all that was felt before it came to rest."""
        thread.ask()
        if (advice := thread.taken()) is not None:
            bench.rig.advise(advice, bench.t, bench.t)

    def _supervise(self, bench: Bench) -> None:
        t = bench.t
        for event in self.processes.act(lambda kind: bench.rig.fails(kind, t)):
            if event == "daemon killed":
                bench.host_died()
            elif event == "daemon started":
                bench.host_begins()
            elif event == "subscriber printed":
                self._listener.judge.came_back("subscriber_dead", t)
