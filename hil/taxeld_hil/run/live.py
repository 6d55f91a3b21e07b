"""Runs in real time: the daemon is a process of its own, fed by a virtual skin or by hardware."""

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

from taxeld.arrays import Poses
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
from taxeld_hil.rig.rig import BEFORE_S, SETTLE_S, Rig
from taxeld_hil.run.session_run import SessionRun, write_truth
from taxeld_hil.scenario import settings
from taxeld_hil.scenario.scenario import KINDS, OF_FRAMES, Scenario
from taxeld_hil.world.world import load_model

START_S = 60.0  # until the first scan; a busy machine has taken 20 s to start a daemon
GRACE_S = 5.0  # for the daemon to stop
STEP_MS = 2
VCAN = "vcan0"  # of transport can
COUNTED_S = 20.0  # at most, until the daemon has counted all that it was sent
CONTACT_S = 120.0  # on hardware: longest that the operator may take for each contact
NOT_INJECTED = {  # transport → kinds of faults
    "can": ("unplugged", "adapter_closed"),  # something else brings the interface up and down
    "native": ("adapter_closed",),
    "array": OF_FRAMES,
}
TARGETS = {"can": "can", "serial": "native", "slcan": "slcan"}  # the target's kind → transport
ON_HARDWARE = "daemon_killed"  # the one kind of fault that is possible there
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
    """A run in real time. A virtual skin and robot feed the daemon over a transport; or the
    operator's robot moves and touches, and the daemon listens to the device. Nothing is injected
    into a real skin; the daemon can be killed."""

    clock = "real"

    def __init__(
        self,
        scenario: Scenario,
        seed: int,
        say: Say = lambda _: None,
        target: str = "sim",
        poses: str = "",
        truth: Poses | None = None,
    ) -> None:
        """`say` prints lines as the run goes on; `target`: sim, can:can0, serial:/dev/ttyACM0 or
        slcan:/dev/ttyACM0. Of a real skin `poses` is the robot's endpoint, empty: the sensor stands
        still, and `truth` (3,) is of the object in the robot's world.

        Raises:
            SetupError: the target is malformed, the scenario needs the fake clock or does not fit
                the skin, or the daemon would refuse a bundle on this layout.
        """
        kind, _, self._channel = target.partition(":")
        self.seed, self.target, self._poses, self._say = seed, target, poses, say
        self._bench: Bench | None = None
        if target == "sim":
            self.rigs = [Rig(scenario.in_real_time(), seed)]
            self.not_injected = NOT_INJECTED.get(scenario.transport, ())
            truth = self.rigs[0].world.truth
        elif kind in TARGETS and self._channel:
            scenario = scenario.over(TARGETS[kind]).in_real_time()
            self.not_injected = tuple(kind for kind in KINDS if kind != ON_HARDWARE)
        else:
            named = ", ".join(f"{name}:DEVICE" for name in TARGETS)
            raise SetupError(f"--target: '{target}' is none of sim, {named}")
        self.scenario, self.truth = scenario, truth
        self._start_s: float | None = None  # of scenario time
        self._health: dict[str, Any] = {}  # the last
        self._resident_mb = list[float]()  # with each message of health
        self._in_contact, self._most_taxels = False, 0
        self._is_done = False  # all contacts were made, and the last is over
        self._is_over = False  # all is sent, and counters alone are waited for
        self._scene = load_model(scenario).scene
        known = SceneConfig(bundles=scenario.known)
        bundle.load_all(known, [layouts.load(scenario.skin_layout)])

    @property
    def t(self) -> float:
        """Scenario time."""
        if self._bench is not None:
            return self._bench.t
        return BEFORE_S if self._start_s is None else time.monotonic() - self._start_s

    def _config(self, place: Path) -> str:
        level = "warning"
        if self.rigs:
            self._where = VCAN if self.scenario.transport == "can" else place / "skin"
            self._channel, self._poses = str(self._where), f"ipc://{place}/poses"
            level = "error"  # the daemon warns of injected faults, which are in the ledger
        text = settings.text(self.scenario, self.seed, self._channel, self._poses, place)
        return f'{text}[log]\nlevel = "{level}"\n'

    def _play(self, directory: Path, place: Path) -> None:
        """Raises SetupError where a process fails or nothing starts."""
        with ExitStack() as opened:
            if self.rigs:
                recorder = opened.enter_context(Recorder(directory, moves=True))
                self._bench = Bench(self.rigs[0], self._where, self._poses, recorder.take)
                opened.enter_context(closing(self._bench))
            else:
                times = self.scenario.contacts
                self._say(f"touch the object {times} times, after a second of touching nothing")
            if self.truth is not None:
                write_truth(directory, self.truth)
            self._say(HEADER + "  object" * (len(self.scenario.known) > 1))
            self.daemon = opened.enter_context(LiveDaemon(directory / session.CONFIG, place))
            self._follow()
        if values := self._resident_mb:  # by the medians of the first and of the last third
            third = max(len(values) // 3, 1)
            self.growth_mb = round(median(values[-third:]) - median(values[:third]), 1)

    def _follow(self) -> None:
        began, bench = time.monotonic(), self._bench
        killed = [fault for fault in self.scenario.fault if fault.kind == ON_HARDWARE]
        while not self._ends(max((fault.end_s for fault in killed), default=0.0)):
            self._step()
            is_dead = any(fault.at_s <= self.t < fault.end_s for fault in killed)
            if self.daemon.act(is_dead=is_dead) and bench is not None:
                (bench.port.forget if is_dead else bench.rig.ledger.begin)()
            if self.t == BEFORE_S and time.monotonic() - began > START_S:
                cure = "'taxeld-hil accept' checks a skin"
                raise SetupError(f"{self.target}: no scan came within {START_S:g} s; {cure}")
        self.end_s = self.t
        if bench is not None:
            self._settle(bench)
        self.daemon.stop()

    def _ends(self, killed_s: float) -> bool:
        """Whether the time is up, or all contacts are made and the last restart is long over."""
        if self._bench is not None:
            return self.t >= self._bench.rig.duration_s
        is_late = self.t > CONTACT_S * self.scenario.contacts
        wait_s = self.scenario.expect.recovery_s + SETTLE_S
        return is_late or (self._is_done and self.t > killed_s + wait_s)

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
                add(self.published, self.t, topic, body)
        if self._bench is not None:
            self._bench.step()

    def _estimated(self, message: dict[str, Any]) -> None:
        if self._start_s is None and message["t"] > 0.0:
            self._start_s = time.monotonic()
        enough = message["contacts"] >= self.scenario.contacts
        self._is_done = enough and not message["contact"]
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
        if self.truth is not None:
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
