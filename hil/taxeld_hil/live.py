"""A run in real time: the daemon as a process of its own, fed by a virtual skin or by hardware, and
what it publishes graded as it comes."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import zmq

from taxeld import client, messages, session
from taxeld.errors import SetupError
from taxeld.estimate import Status
from taxeld_hil import processes, settings
from taxeld_hil.bench import Bench, write_truth
from taxeld_hil.flags import Health
from taxeld_hil.grade import Grade, Run, grade
from taxeld_hil.judge import Judge, Sample
from taxeld_hil.reconcile import Law, laws
from taxeld_hil.rig import Rig, Worlds
from taxeld_hil.scenario import Scenario
from taxeld_hil.watch import HEADER, Watch
from taxeld_hil.world import World

START_S = 20.0  # until the first estimate
STEP_MS = 2
SETTLED_S = 0.25  # a health so long after the last frame has all of it
LAST_HEALTH_S = 5.0
HEAR_OUT_S = 0.2
NOT_ON_CAN = ("unplugged",)  # something else brings the interface up and down
Say = Callable[[str], None]


class LiveRun:
    """A scenario on a virtual skin over a real transport; or several, lap by lap, on one daemon."""

    def __init__(
        self, name: str, scenario: Scenario, seed: int, directory: Path, channel: str, say: Say
    ) -> None:
        """`directory` gets the session; `channel`: a CAN interface, unused on other transports;
        `say` is told what is to be printed."""
        self.run = Run(name, seed, "sim", "real", scenario.transport)
        self.scenario = scenario
        self._directory = directory
        self._channel = channel
        self._say = say
        self._final: Health | None = None
        self._finished_wall = np.inf

    def graded(self, place: Path, world: Worlds = World) -> Grade:
        """To the end; sockets and links are made in `place`.

        Raises:
            SetupError: a process failed, or the interface is not there.
        """
        with self.opened(place, world) as bench:
            self._say(HEADER)
            self._serve(bench)
            held = self.settled(bench)
        self._judge.end(bench.rig.duration_s)
        for line in self._watch.latencies():
            self._say(line)
        self._say(f"final symmetry-aware ADD {self._watch.error_mm():.1f} mm")
        return grade(self.run, self._judge, held, bench.rig.ledger)

    def lap(self, bench: Bench, name: str, scenario: Scenario, seed: int) -> Grade:
        """Another scenario on the same daemon, which forgets the object; nothing is said of it, and
        accounts are settled in the end.

        Raises:
            SetupError: a process failed.
        """
        if bench.start_s is not None:
            self._reset(bench)
        bench.lap(scenario, seed)
        self._begin(bench.rig)
        self._serve(bench)
        self._judge.end(bench.rig.duration_s)
        return grade(replace(self.run, scenario=name), self._judge, [], bench.rig.ledger)

    @contextmanager
    def opened(self, place: Path, world: Worlds = World) -> Iterator[Bench]:
        """With everything running; whatever happens, it is stopped in the end."""
        scenario, rig = self.scenario, Rig(self.scenario, self.run.seed, world)
        self._directory.mkdir(parents=True, exist_ok=True)
        where: Path | str = self._channel if scenario.transport == "can" else place / "skin"
        config = settings.text(scenario, self.run.seed, str(where), f"ipc://{place}/poses", place)
        (self._directory / session.CONFIG).write_text(config, encoding="utf-8")
        write_truth(self._directory, rig)
        self._place = place
        self._begin(rig)
        with ExitStack() as stack:
            context = stack.enter_context(zmq.Context())
            poses = _socket(stack, context, zmq.XPUB)
            poses.bind(f"ipc://{place}/poses")
            recorder = stack.enter_context(session.Recorder(self._directory, moves=True))
            bench = Bench(rig, where, poses, recorder)
            stack.callback(bench.close)
            self._stream = _socket(stack, context, zmq.SUB)
            self._stream.connect(f"ipc://{place}/stream")
            for topic in (messages.ESTIMATE, messages.TAXELS, messages.HEALTH):
                self._stream.setsockopt(zmq.SUBSCRIBE, topic)
            self._poller = zmq.Poller()
            self._poller.register(self._stream, zmq.POLLIN)
            self.daemon = processes.daemon(self._directory / session.CONFIG)
            self._subscriber = processes.subscriber(
                f"ipc://{place}/stream", scenario.bundle, scenario.layout
            )
            for process in (self.daemon, self._subscriber):
                stack.callback(process.kill)
                process.start()
            yield bench
            self._subscriber.stop()
            self.daemon.stop()

    def settled(self, bench: Bench) -> list[Law]:
        """The accounts, once the daemon has told of all that it was sent."""
        bench.finish()
        self._finished_wall = time.time()
        deadline = time.monotonic() + LAST_HEALTH_S
        while self._final is None and time.monotonic() < deadline:
            self._poller.poll(STEP_MS)
            bench.step()
            self._hear(bench)
        rig = bench.rig
        return laws(rig.ledger, self._final or {}, line=rig.line, exact_times=False)

    def _reset(self, bench: Bench) -> None:
        """Have the daemon forget the object, and hear out what it has said of it."""
        if client.ask(f"ipc://{self._place}/control", "reset") is None:
            raise SetupError("the daemon did not answer within 2 s")
        heard_out = time.monotonic() + HEAR_OUT_S
        while time.monotonic() < heard_out:
            self._poller.poll(STEP_MS)
            bench.step()
            while self._stream.poll(0):
                self._stream.recv_multipart()

    def _begin(self, rig: Rig) -> None:
        scene, truth = rig.model.scene, rig.world.truth
        not_injected = NOT_ON_CAN if rig.scenario.transport == "can" else ()
        self._judge = Judge(rig.scenario, scene, truth, not_injected, rig.taxels_of)
        self._watch = Watch(scene, truth)

    def _serve(self, bench: Bench) -> None:
        began = time.monotonic()
        while bench.t < bench.rig.duration_s:
            self._poller.poll(STEP_MS)
            bench.step()
            self._hear(bench)
            self._supervise(bench)
            if bench.start_s is None and time.monotonic() - began > START_S:
                raise SetupError(f"the daemon did not start the skin within {START_S:g} s")

    def _supervise(self, bench: Bench) -> None:
        """Kill and start what the scenario says."""
        rig, t = bench.rig, bench.t
        for kind, process in (
            ("daemon_killed", self.daemon), ("subscriber_dead", self._subscriber),
        ):  # fmt: skip
            process.check()
            if rig.fails(kind, t) and process.is_running:
                process.kill()
                if process is self.daemon:
                    bench.host_died()
            elif not rig.fails(kind, t) and not process.is_running:
                if process is self.daemon:
                    bench.host_begins()
                process.start()
        if self._subscriber.has_spoken():
            self._judge.spoke("subscriber_dead", t)

    def _hear(self, bench: Bench) -> None:
        while self._stream.poll(0):
            topic, body, _ = self._stream.recv_multipart()
            message = msgpack.unpackb(body)
            if topic == messages.TAXELS:
                self._watch.on_taxels(message)
            elif topic == messages.HEALTH:
                self._on_health(bench, message)
            elif time.time() < self._finished_wall:
                line = self._watch.on_estimate(message)
                if line:
                    self._say(line)
                self._judge.on_estimate(sample(message, bench.t))

    def _on_health(self, bench: Bench, message: dict[str, Any]) -> None:
        self._judge.on_health(bench.t, message)
        if message["t"] > self._finished_wall + SETTLED_S:
            self._final = message


def sample(message: dict[str, Any], t: float) -> Sample:
    """An estimate's message, received at scenario time t."""
    pose = message["map"]
    return Sample(
        t,
        Status(message["status"]),
        message["valid"],
        message["contacts"],
        np.array([pose["x"], pose["y"], pose["theta"]]),
        message["t"],
        1e-6 * message["age_us"],
        message["lat_us"]["total"],
    )


def _socket(stack: ExitStack, context: "zmq.Context[Any]", kind: int) -> "zmq.Socket[Any]":
    socket: zmq.Socket[Any] = stack.enter_context(context.socket(kind))
    socket.setsockopt(zmq.LINGER, 0)
    return socket
