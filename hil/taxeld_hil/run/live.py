"""Runs in real time: the daemon is a process of its own, fed by a virtual skin."""

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from statistics import median
from typing import Any

import msgpack
import numpy as np
import zmq

from taxeld.config.tables import SceneConfig
from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.model.symmetry import add_m
from taxeld.proposals import bundle
from taxeld.source import session
from taxeld.source.recorder import Recorder
from taxeld.stream import messages, topics
from taxeld_hil.grade.reconcile import laws
from taxeld_hil.grade.session import add
from taxeld_hil.rig.bench import Bench
from taxeld_hil.rig.rig import Rig
from taxeld_hil.run.session_run import SessionRun, write_truth
from taxeld_hil.scenario import settings
from taxeld_hil.scenario.scenario import OF_FRAMES, Scenario
from taxeld_hil.scenario.staged import load_model

START_S = 60.0  # until the first scan; a busy machine has taken 20 s to start a daemon
GRACE_S = 5.0  # for the daemon to stop
STEP_MS = 2
VCAN = "vcan0"  # of transport can
COUNTED_S = 20.0  # at most, until the daemon has counted all that it was sent
NOT_INJECTED = {  # transport → kinds of faults
    "can": ("unplugged", "adapter_closed"),  # something else brings the interface up and down
    "native": ("adapter_closed",),
    "array": OF_FRAMES,
}
KILLED = "daemon_killed"
HEADER = (
    "contact  taxels  modes       p  radius [mm]  likeliest x, y, yaw [mm, mm, deg]  error [mm]"
)

Say = Callable[[str], None]


class LiveDaemon(ExitStack):
    """The daemon's process, which may be killed, and a subscriber of its streams."""

    def __init__(self, config: Path, place: Path) -> None:
        """`config`: its file, by which its sockets are in `place`."""
        super().__init__()
        self._command = [sys.executable, "-m", "taxeld.cli", "run", str(config)]
        context: zmq.Context[Any] = self.enter_context(zmq.Context())
        self._own: zmq.Socket[Any] = self.enter_context(context.socket(zmq.SUB))
        self._own.setsockopt(zmq.LINGER, 0)
        for topic in (topics.ESTIMATE, topics.TAXELS, topics.HEALTH):
            self._own.setsockopt(zmq.SUBSCRIBE, topic)
        self._own.connect(f"ipc://{place}/stream")
        self._process: subprocess.Popen[bytes] | None = None
        self.callback(self._kill)
        self._start()

    @property
    def resident_mb(self) -> float:
        """Resident memory of the daemon; 0 while it does not run."""
        if self._process is None:
            return 0.0
        status = Path(f"/proc/{self._process.pid}/status").read_text(encoding="ascii")
        return sum(int(s.split()[1]) for s in status.splitlines() if s[:6] == "VmRSS:") / 1024.0

    def messages(self, wait_ms: int) -> Iterator[tuple[bytes, bytes]]:
        """Topics and bodies of what has come; the first is waited for."""
        while self._own.poll(wait_ms):
            topic, body, _ = self._own.recv_multipart()
            yield topic, body
            wait_ms = 0

    def act(self, *, is_dead: bool) -> bool:
        """Kill the daemon or start it; → whether that was to be done.

        Raises:
            SetupError: the daemon has ended by itself; its own message says why.
        """
        if self._process is not None and (status := self._process.poll()) is not None:
            raise SetupError(f"the daemon ended early, with status {status}")
        if is_dead == (self._process is None):
            return False
        (self._kill if is_dead else self._start)()
        return True

    def stop(self) -> None:
        """Raises SetupError where the daemon does not stop as asked."""
        if self._process is None:
            return
        self._process.terminate()
        try:
            status = self._process.wait(GRACE_S)
        except subprocess.TimeoutExpired:
            raise SetupError(f"the daemon did not stop within {GRACE_S:g} s") from None
        if status:
            raise SetupError(f"the daemon ended with status {status}")

    def _start(self) -> None:
        self._process = subprocess.Popen(self._command)  # noqa: S603

    def _kill(self) -> None:
        """End it as a crash would."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None


class LiveRun(SessionRun):
    """A run in real time: a virtual skin and robot feed the daemon over a transport."""

    clock = "real"
    _bench: Bench

    def __init__(self, scenario: Scenario, seed: int, say: Say = lambda _: None) -> None:
        """`say` prints lines as the run goes on.

        Raises:
            SetupError: the scenario needs the fake clock or does not fit the skin, or the daemon
                would refuse a bundle on this layout.
        """
        self.scenario, self.seed, self._say = scenario, seed, say
        self.rigs = [Rig(scenario.in_real_time(), seed)]
        self.truth = self.rigs[0].world.truth
        self.not_injected = NOT_INJECTED.get(scenario.transport, ())
        self._health: dict[str, Any] = {}  # the last
        self._resident_mb = list[float]()  # with each message of health
        self._in_contact, self._most_taxels = False, 0
        self._is_over = False  # all is sent, and counters alone are waited for
        self._scene = load_model(scenario).scene
        known = SceneConfig(bundles=scenario.known)
        bundle.load_all(known, [layouts.load(scenario.skin_layout)])

    def _config(self, place: Path) -> str:
        self._poses = f"ipc://{place}/poses"
        self._where = VCAN if self.scenario.transport == "can" else place / "skin"
        text = settings.text(self.scenario, self.seed, str(self._where), self._poses, place)
        # the daemon warns of injected faults, which are in the ledger
        return f'{text}[log]\nlevel = "error"\n'

    def _play(self, directory: Path, place: Path) -> None:
        """Raises SetupError where a process fails or nothing starts."""
        with ExitStack() as opened:
            recorder = opened.enter_context(Recorder(directory, moves=True))
            self._bench = Bench(self.rigs[0], self._where, self._poses, recorder.take)
            opened.enter_context(closing(self._bench))
            write_truth(directory, self.truth)
            self._say(HEADER + "  object" * (len(self.scenario.known) > 1))
            self.daemon = opened.enter_context(LiveDaemon(directory / session.CONFIG, place))
            self._follow()
        if values := self._resident_mb:  # by the medians of the first and of the last third
            third = max(len(values) // 3, 1)
            self.growth_mb = round(median(values[-third:]) - median(values[:third]), 1)

    def _follow(self) -> None:
        began, bench = time.monotonic(), self._bench
        killed = [fault for fault in self.scenario.fault if fault.kind == KILLED]
        while bench.t < bench.rig.duration_s:
            self._step()
            is_dead = any(fault.at_s <= bench.t < fault.end_s for fault in killed)
            if self.daemon.act(is_dead=is_dead):
                (bench.port.forget if is_dead else bench.rig.ledger.begin)()
            if bench.start_s is None and time.monotonic() - began > START_S:
                raise SetupError(f"no host started the skin within {START_S:g} s")
        self.end_s = bench.t
        self._settle(bench)
        self.daemon.stop()

    def _settle(self, bench: Bench) -> None:
        """Send what was held back, and wait until all is counted, or for COUNTED_S."""
        bench.finish()
        self._is_over, deadline = True, time.monotonic() + COUNTED_S
        while time.monotonic() < deadline:
            self._step()
            held = laws(bench.rig.ledger.entries(), self._health, line=bench.rig.line)
            if all(law.holds for law in held):
                return

    def _step(self) -> None:
        """Take what the daemon has published, and do what is due on the bench."""
        for topic, body in self.daemon.messages(STEP_MS):
            message = msgpack.unpackb(body)
            if topic == topics.TAXELS:
                self._most_taxels = max(self._most_taxels, sum(z > 0 for z in message["z"]))
                continue
            if topic == topics.HEALTH:
                self._health = message
                self._resident_mb.append(self.daemon.resident_mb)
            elif self._is_over:
                continue
            else:
                self._estimated(message)
            if self.published is not None:
                add(self.published, self._bench.t, topic, body)
        self._bench.step()

    def _estimated(self, message: dict[str, Any]) -> None:
        if self._in_contact and not message["contact"]:
            self._say(self._line(message))
            self._most_taxels = 0
        self._in_contact = message["contact"]

    def _line(self, message: dict[str, Any]) -> str:
        """On a contact that has ended."""
        pose = np.array([message["map"][key] for key in ("x", "y", "theta")])
        (x, y), yaw = 1e3 * pose[:2], np.degrees(pose[2])
        line = (
            f"{message['contacts']:7d} {self._most_taxels:7d} {len(message['modes']):6d} "
            f"{message['p']:7.1%} {1e3 * message['radius_m']:12.1f}    "
            f"({x:7.1f}, {y:7.1f}, {yaw:6.1f})"
        )
        is_valid = message["valid"]
        error_m = add_m(self._scene, pose, self.truth)[1] if is_valid else np.nan
        line += f" {1e3 * error_m:16.1f}"
        return line + f"  {messages.object_of(message)}" * (len(self.scenario.known) > 1)


def emulate(
    scenario: Scenario, seed: int, endpoint: str, where: Path | str, directory: Path
) -> bool:
    """Serve the virtual skin alone, publish the robot's poses on `endpoint`, record into
    `directory`; → whether a host came and stayed to the end.

    `where`: a link that will point to a pseudo-terminal, or a CAN interface's name.

    Raises:
        SetupError: there is no such interface, the endpoint is taken, or the directory holds a
            session.
    """
    rig, began = Rig(scenario.in_real_time(), seed), time.monotonic()
    with (
        Recorder(directory, moves=True) as recorder,
        closing(Bench(rig, where, endpoint, recorder.take)) as bench,
    ):
        write_truth(directory, rig.world.truth)
        while bench.t < rig.duration_s:
            time.sleep(1e-3 * STEP_MS)
            bench.step()
            if bench.start_s is None and time.monotonic() - began > START_S:
                return False
        return not bench.was_stopped
