"""Runs in real time: the daemon is a process of its own, fed by a virtual skin or by hardware."""

import tempfile
import time
from abc import abstractmethod
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any, Self

import msgpack
import numpy as np
import zmq

from taxeld.arrays import Poses
from taxeld.config.tables import SceneConfig
from taxeld.door.binding import bound
from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.model.scene import Scene
from taxeld.proposals import bundle
from taxeld.source.recorder import Recorder
from taxeld.stream import topics
from taxeld_hil.grade.reconcile import laws
from taxeld_hil.grade.session import Run, add
from taxeld_hil.rig.bench import Bench
from taxeld_hil.rig.rig import BEFORE_S, SETTLE_S, Rig
from taxeld_hil.run.processes import LiveDaemon
from taxeld_hil.run.session_run import SessionRun, write_truth
from taxeld_hil.run.table import HEADER, OBJECT, ContactTable
from taxeld_hil.scenario import settings
from taxeld_hil.scenario.scenario import KINDS, OF_FRAMES, Scenario
from taxeld_hil.world.world import load_model

START_S = 60.0  # until the first scan; a busy machine has taken 20 s to start a daemon
STEP_MS = 2
VCAN = "vcan0"  # of transport can
COUNTED_S = 20.0  # at most, until the daemon has counted all that it was sent
DRAIN_S = 0.2
CONTACT_S = 120.0  # on hardware: longest that the operator may take for each contact
NOT_INJECTED = {  # transport → kinds of faults
    "can": ("unplugged", "adapter_closed"),  # something else brings the interface up and down
    "native": ("adapter_closed",),
    "array": OF_FRAMES,
}
TARGETS = {"can": "can", "serial": "native", "slcan": "slcan"}  # the target's kind → transport
ON_HARDWARE = ("daemon_killed", "subscriber_dead")  # kinds of faults that are possible there

Say = Callable[[str], None]


class LiveRun(SessionRun):
    """A run in real time; its processes run while it is entered."""

    no_start = f"the daemon did not start the skin within {START_S:g} s"
    log_level = "error"  # the daemon warns of injected faults, which are in the ledger

    def __init__(self, scenario: Scenario, say: Say) -> None:
        """`say` prints lines as the run goes on.

        Raises:
            SetupError: the scenario needs the fake clock, or the daemon would refuse a bundle on
                this layout.
        """
        self.scenario, self._say = scenario.in_real_time(), say
        self._health: dict[str, Any] = {}  # the last
        self._is_over = False  # all is sent, and counters alone are waited for
        known = SceneConfig(bundles=scenario.known)
        bundle.load_all(known, [layouts.load(scenario.skin_layout)])

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            place = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="taxeld-")))
            text = self._open(stack, place)
            self.config_text = f'{text}[log]\nlevel = "{self.log_level}"\n'
            self.daemon = LiveDaemon(stack, place, self.config_text)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        with self._stack:
            if kind is None:
                self.daemon.stop()

    @property
    @abstractmethod
    def t(self) -> float:
        """Scenario time."""

    @abstractmethod
    def _open(self, stack: ExitStack, place: Path) -> str:
        """Begin what feeds the daemon; → the daemon's configuration. Sockets are in `place`."""

    @abstractmethod
    def _fails(self, kind: str) -> bool:
        """Whether a fault of this kind is on."""

    def _follow(self, scene: Scene, truth: Poses | None, ends: Callable[[], bool]) -> None:
        """Go on to the end. Raises SetupError where a process fails or nothing starts."""
        self._table, began = ContactTable(scene, truth), time.monotonic()
        self._say(HEADER + OBJECT * (len(self.scenario.known) > 1))
        while not ends():
            self._step()
            for event in self.daemon.act(self._fails):
                self._on(event)
            if self.t == BEFORE_S and time.monotonic() - began > START_S:
                raise SetupError(self.no_start)

    def _step(self) -> None:
        """Take what the daemon has published."""
        for topic, body in self.daemon.messages(STEP_MS):
            message = msgpack.unpackb(body)
            if topic == topics.TAXELS:
                self._table.on_taxels(message)
                continue
            if topic == topics.HEALTH:
                self._health = message
            elif self._is_over:
                continue
            else:
                self._estimated(message)
            if self.published is not None:
                add(self.published, self.t, topic, body)

    def _estimated(self, message: dict[str, Any]) -> None:
        if line := self._table.on_estimate(message):
            self._say(line)

    def _on(self, event: str) -> None:
        """Something has happened to a process."""
        if event == "subscriber printed" and self.published is not None:
            add(self.published, self.t, b"subscriber_dead")


class SimulatedRun(LiveRun):
    """A virtual skin and robot feed the daemon over a real transport; or several scenarios do, lap
    by lap."""

    def __init__(self, scenario: Scenario, seed: int, say: Say = lambda _: None) -> None:
        super().__init__(scenario, say)
        self._seed, self.rig = seed, Rig(self.scenario, seed)

    def _open(self, stack: ExitStack, place: Path) -> str:
        context = stack.enter_context(zmq.Context())
        poses: zmq.Socket[Any] = stack.enter_context(context.socket(zmq.XPUB))
        poses.setsockopt(zmq.LINGER, 0)
        poses.bind(f"ipc://{place}/poses")
        where: Path | str = VCAN if self.scenario.transport == "can" else place / "skin"
        self._bench = stack.enter_context(closing(Bench(self.rig, where, poses)))
        at = str(where), f"ipc://{place}/poses", place
        return settings.text(self.scenario, self._seed, *at)

    @property
    def t(self) -> float:
        return self._bench.t

    def lap(self, scenario: Scenario, seed: int) -> None:
        """Have the daemon forget the object, and begin another scenario on the same skin."""
        self.daemon.reset()
        until = time.monotonic() + DRAIN_S
        while time.monotonic() < until:  # what was published of the object before is discarded
            self._step()
        self._bench.lap(scenario, seed)
        self.scenario, self._seed, self._is_over = scenario, seed, False

    def _play(self, directory: Path) -> None:
        rig, truth = self.rig, self.rig.world.truth
        with Recorder(directory, moves=True) as recorder:
            self._bench.record = recorder.take
            write_truth(directory, truth)
            self._follow(rig.model.scene, truth, lambda: self.t >= rig.duration_s)
            self._settle()

    def _settle(self) -> None:
        """Send what was held back, and wait until all is counted, or for COUNTED_S."""
        self._bench.finish()
        self._is_over, deadline = True, time.monotonic() + COUNTED_S
        while time.monotonic() < deadline:
            self._step()
            held = laws(self.rig.ledger.entries(), self._health, line=self.rig.line)
            if all(law.holds for law in held):
                return

    def _about(self, name: str) -> Run:
        rig, scenario = self.rig, self.scenario
        taxels = [rig.taxels_of(fault) for fault in scenario.fault]
        not_injected = NOT_INJECTED.get(scenario.transport, ())
        about = name, self._seed, "sim", "real", scenario, rig.duration_s
        return Run(*about, taxels, not_injected, rig.ledger.entries())

    def _fails(self, kind: str) -> bool:
        return self.rig.fails(kind, self.t)

    def _step(self) -> None:
        super()._step()
        self._bench.step()

    def _on(self, event: str) -> None:
        super()._on(event)
        if event == "daemon killed":
            self._bench.port.forget()
        elif event == "daemon started":  # another host will listen
            self.rig.ledger.begin()


class HardwareRun(LiveRun):
    """The operator's robot moves and touches, and the daemon listens to the device.

    Nothing is injected into a real skin; the daemon and a subscriber can be killed.
    """

    log_level = "warning"

    def __init__(
        self,
        scenario: Scenario,
        target: str,
        poses: str,
        truth: Sequence[float] | None,
        say: Say,
    ) -> None:
        """`target`: can:can0, serial:/dev/ttyACM0 or slcan:/dev/ttyACM0; `poses`: the robot's
        endpoint, empty: the sensor stands still; `truth` (3,) of the object in its world.

        Raises:
            SetupError: the target is malformed.
        """
        kind, _, self._channel = target.partition(":")
        if kind not in TARGETS or not self._channel:
            named = ", ".join(f"{name}:DEVICE" for name in TARGETS)
            raise SetupError(f"--target: '{target}' is none of sim, {named}")
        super().__init__(scenario.over(TARGETS[kind]), say)
        self._target, self._poses = target, poses
        self._truth = None if truth is None else np.array(truth)
        cure = "check the skin with 'taxeld-hil accept'"
        self.no_start = f"{target}: no scan came within {START_S:g} s; {cure}"
        self._start_s: float | None = None  # of scenario time
        self._is_done = False  # all contacts were made, and the last is over

    def _open(self, _: ExitStack, place: Path) -> str:
        return settings.text(self.scenario, 0, self._channel, self._poses, place)

    @property
    def t(self) -> float:
        return BEFORE_S if self._start_s is None else time.monotonic() - self._start_s

    def _play(self, directory: Path) -> None:
        if self._truth is not None:
            write_truth(directory, self._truth)
        contacts = self.scenario.contacts
        self._say(f"touch the object {contacts} times, after a second of touching nothing")
        scene = load_model(self.scenario).scene
        self._follow(scene, self._truth, self._ends)

    def _fails(self, kind: str) -> bool:
        on = [fault for fault in self.scenario.fault if fault.at_s <= self.t < fault.end_s]
        return kind in ON_HARDWARE and any(fault.kind == kind for fault in on)

    def _estimated(self, message: dict[str, Any]) -> None:
        if self._start_s is None and message["t"] > 0.0:
            self._start_s = time.monotonic()
        enough = message["contacts"] >= self.scenario.contacts
        self._is_done = enough and not message["contact"]
        super()._estimated(message)

    def _ends(self) -> bool:
        """Whether the time is up, or all contacts are made and the faults long over."""
        wait_s = self.scenario.expect.recovery_s + SETTLE_S
        ends = [fault.end_s for fault in self.scenario.fault if fault.kind in ON_HARDWARE]
        is_late = self.t > CONTACT_S * self.scenario.contacts
        return is_late or (self._is_done and self.t > max(ends, default=0.0) + wait_s)

    def _about(self, name: str) -> Run:
        taxels = [()] * len(self.scenario.fault)
        not_injected = tuple(kind for kind in KINDS if kind not in ON_HARDWARE)
        return Run(name, 0, self._target, "real", self.scenario, self.t, taxels, not_injected)


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
    with ExitStack() as stack:
        context = stack.enter_context(zmq.Context())
        poses = stack.enter_context(context.socket(zmq.XPUB))
        poses.setsockopt(zmq.LINGER, 0)
        stack.enter_context(bound(poses, endpoint, "--poses"))
        recorder = stack.enter_context(Recorder(directory, moves=True))
        write_truth(directory, rig.world.truth)
        bench = stack.enter_context(closing(Bench(rig, where, poses, recorder.take)))
        while bench.t < rig.duration_s:
            time.sleep(1e-3 * STEP_MS)
            bench.step()
            if bench.start_s is None and time.monotonic() - began > START_S:
                return False
        return not bench.was_stopped
