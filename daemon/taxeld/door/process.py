"""The process: it waits for the loop and for all peers at once, and lives as long as the pair."""

import contextlib
import logging
import signal
import socket
import sys
import time
from dataclasses import asdict
from typing import Any, NamedTuple

import msgpack
import zmq

from taxeld.config import endpoints
from taxeld.door import control, limits
from taxeld.door.admission import Admission
from taxeld.door.arrays import Published
from taxeld.door.binding import Binding, NotNowError
from taxeld.door.control import Control, MayChange, packed_error, packed_ok
from taxeld.door.robot import Pose, Robot
from taxeld.door.settings import Settings
from taxeld.door.streams import Streams, open_publisher
from taxeld.errors import SetupError
from taxeld.stream import curve, pair
from taxeld.stream.curve import RelayKeys, RobotKeys
from taxeld.stream.link import Report
from taxeld.stream.pair import Kind
from taxeld.stream.topics import ESTIMATE, HEALTH, INFO
from taxeld_protocol.array import ArrayFrame

WAIT_MS = 100  # for a peer or the loop
LOOK_S, REPORT_S = 0.1, 1.0
PACKETS_PER_LOOK = 256
SILENT_S = 2.0  # without an estimate for so long, the loop hangs
NOTHING = b"\x80"  # an empty map
log = logging.getLogger("taxeld")


class _Keys(NamedTuple):
    """Keys of the robot's connection and of the endpoints over TCP; None where none are used."""

    robot: RobotKeys | None
    relay: RelayKeys | None


class Door:
    """All endpoints of a configuration, being served."""

    def __init__(self, settings: Settings, end: socket.socket) -> None:
        """`end`: of the pair.

        Raises:
            SetupError: an endpoint or a key cannot be used.
        """
        self._end = end
        self._report = Report()
        self._latest: dict[bytes, bytes] = {}
        self._state: dict[str, bytes] = {}
        self._estimate_s = time.monotonic()
        self._wanted: set[bytes] | None = None
        self._memory = b""
        self._is_at_work = False  # whether the loop has sent an estimate
        self._next_look_s = self._next_report_s = 0.0
        self._streams: list[Streams] = []
        self._publishers: dict[tuple[str, bool], Streams] = {}  # by key, and whether keys are taken
        self._controls: list[Control] = []
        self._bindings: list[Binding] = []
        self._unbound: list[tuple[Binding, zmq.Socket[Any]]] = []  # addresses to be tried again
        self._robot: Robot | None = None
        self._array: Published | None = None
        self._admission: Admission | None = None
        self._estimates = settings.estimates
        keys = _keys(settings)
        members = control.for_members(settings.change_group)
        for endpoint in filter(None, (*settings.publish, settings.control)):
            endpoints.make_directory(endpoint)
        with contextlib.ExitStack() as opened:
            context: zmq.Context[Any] = opened.enter_context(zmq.Context())
            opened.callback(self._close_all)
            self._open(context, settings, keys, members)
            self._opened = opened.pop_all()
        limits.start_no_more()
        self._answers = {
            "status": self._on_status,
            "info": self._on_info,
            "memory": self._on_memory,
        }
        self._make_poller()

    def run(self) -> None:
        """Serve until the loop is gone."""
        pair.send(self._end, Kind.READY)
        with contextlib.suppress(EOFError, ConnectionError):
            while True:
                self._pass(dict(self._poller.poll(WAIT_MS)))

    def close(self) -> None:
        self._opened.close()

    def _pass(self, ready: dict[Any, int]) -> None:
        now_s = time.monotonic()
        changed = self._end.fileno() in ready and self._take_from_loop(now_s)
        if self._robot is not None and self._robot.socket in ready:
            changed |= self._take_poses(self._robot, now_s)
        if self._array is not None and self._array.socket in ready:
            if self._robot is not None:  # a scan is placed by the poses before it
                changed |= self._take_poses(self._robot, now_s)
            self._array.poll(now_s)
        if self._admission is not None and self._admission.socket in ready:
            self._admission.answer()
        for stream in self._streams:
            if stream.socket in ready:
                stream.listen()
                self._next_look_s = now_s
        for served in self._controls:
            if served.socket in ready:
                served.poll(now_s, self._answers, self._pass_on)
        if now_s >= self._next_look_s:
            self._next_look_s = now_s + LOOK_S
            changed |= self._look(now_s)
        if changed:
            self._make_poller()

    def _look(self, now_s: float) -> bool:
        """Do the work that need not be done in each pass; → whether the poller must change."""
        for stream in self._streams:
            stream.look()
            stream.greet(now_s, self._info())
        for served in self._controls:
            served.look(now_s)
        self._tell_wanted()
        if now_s >= self._next_report_s:
            self._next_report_s = now_s + REPORT_S
            self._bind_again()
            self._send_report()
        changed = self._array is not None and self._array.look(now_s)
        if self._robot is None:
            return changed
        changed |= self._take_poses(self._robot, now_s)
        return self._robot.look(now_s) or changed

    def _take_poses(self, robot: Robot, now_s: float) -> bool:
        """Pass on the poses that have come; → whether the poller must change.

        The robot's socket is waited on only while the loop awaits a pose: a wake for each pose
        would cost more than all else that this process does.
        """
        was_awaited = robot.is_awaited
        robot.poll(now_s)
        return robot.is_awaited is not was_awaited

    def _take_from_loop(self, now_s: float) -> bool:
        """→ whether the poller must change."""
        changed = False
        for _ in range(PACKETS_PER_LOOK):
            packet = pair.receive(self._end)
            if packet is None:
                break
            changed |= self._take(now_s, *packet)
        return changed

    def _take(self, now_s: float, kind: int, values: list[Any]) -> bool:
        """→ whether the poller must change."""
        match kind, values:
            case Kind.MESSAGE, [topic, t, body]:
                self._forward(now_s, topic, body, t)
            case Kind.STATE, [state]:
                self._state = {name: msgpack.packb(value) for name, value in state.items()}
            case Kind.MEMORY, [scans]:
                self._memory = msgpack.packb(scans)
            case Kind.ANSWER, [number, why]:
                for served in self._controls:
                    served.done(number, why)
            case Kind.ASK, [also_next] if self._robot is not None:
                was_awaited = self._robot.is_awaited
                changed = self._take_poses(self._robot, now_s)
                self._robot.is_awaited = also_next
                return changed or also_next is not was_awaited
        return False

    def _forward(self, now_s: float, topic: bytes, body: bytes, t: float) -> None:
        self._latest[topic] = body
        if topic == INFO:  # for newcomers, who are greeted with it
            return
        if topic == ESTIMATE:
            self._estimate_s = now_s
            if not self._is_at_work:  # requests have waited for the loop's first estimate
                self._is_at_work = True
                self._make_poller()
            if not self._estimates:  # it is for `status` alone
                return
        frames = [topic, body, b"%.6f" % t]
        for stream in self._streams:
            stream.send(frames)

    def _info(self) -> list[bytes]:
        """The message; empty while the loop has not spoken."""
        if INFO not in self._latest:
            return []
        return [INFO, self._latest[INFO], b"%.6f" % time.time()]

    def _on_poses(self, poses: list[Pose], link: int) -> bool:
        return pair.send(self._end, Kind.POSES, link, poses)

    def _on_array(self, frame: ArrayFrame) -> bool:
        return pair.send(self._end, Kind.ARRAY, frame.t, frame.id, frame.rest, frame.counts)

    def _pass_on(self, number: int, command: str, arguments: dict[str, Any]) -> bool:
        return pair.send(self._end, Kind.CHANGE, number, command, arguments)

    def _on_status(self) -> bytes:
        if time.monotonic() > self._estimate_s + SILENT_S:
            return packed_error("the loop is silent; the log of the daemon may say why")
        latest = {"estimate": self._latest[ESTIMATE], "health": self._latest.get(HEALTH, NOTHING)}
        return packed_ok(**latest, **self._state)

    def _on_memory(self) -> bytes:
        if not self._memory:
            return packed_error("nothing was felt yet: touch the object first")
        return packed_ok(memory=self._memory)

    def _on_info(self) -> bytes:
        return packed_ok(info=self._latest[INFO])

    def _tell_wanted(self) -> None:
        wanted = set[bytes]().union(*(stream.wanted for stream in self._streams))
        if wanted != self._wanted and pair.send(self._end, Kind.WANTED, sorted(wanted)):
            self._wanted = wanted

    def _send_report(self) -> None:
        if self._admission is not None:
            self._report.keys_refused = self._admission.refused
        self._report.unbound = len(self._unbound)
        pair.send(self._end, Kind.REPORT, asdict(self._report))

    def _open(
        self, context: zmq.Context[Any], settings: Settings, keys: _Keys, members: MayChange
    ) -> None:
        """All sockets; `members`: who may change something at the ipc endpoint."""
        if keys.relay is not None:
            self._admission = Admission(context, keys.relay)
        for endpoint in settings.publish:
            self._publish(context, settings, endpoint, "publish.endpoints")
        for endpoint in settings.relay_publish:
            self._publish(context, settings, endpoint, "relay.publish")
        refused = "" if settings.relay_change else "not over TCP: relay.change is false"
        self._serve(context, settings.control, "control.endpoint", members)
        self._serve(context, settings.relay_control, "relay.control", lambda _: refused)
        if settings.robot:
            now_s = time.monotonic()
            self._robot = Robot(
                context, settings.robot, self._on_poses, keys.robot, now_s, settings.topics
            )
            self._report.robot = self._robot.line
        if settings.array:
            self._array = Published(context, settings.array, self._on_array)
            self._report.array = self._array.line

    def _guard_of(self, endpoint: str) -> Admission | None:
        """The admission of an endpoint that takes keys; None for another."""
        return self._admission if curve.takes_keys(endpoint) else None

    def _publish(
        self, context: zmq.Context[Any], settings: Settings, endpoint: str, key: str
    ) -> None:
        """Endpoints that are alike share a socket."""
        guard = self._guard_of(endpoint)
        alike = (key, guard is not None)
        if alike not in self._publishers:
            publisher = open_publisher(context, settings.queue)
            if guard is not None:
                guard.serve(publisher)
            made = Streams(publisher)
            self._publishers[alike] = made
            self._streams.append(made)
        self._bind(self._publishers[alike].socket, endpoint, key)

    def _serve(
        self, context: zmq.Context[Any], endpoint: str, key: str, may_change: MayChange
    ) -> None:
        if endpoint:
            router = control.open_router(context)
            if (guard := self._guard_of(endpoint)) is not None:
                guard.serve(router)
            self._controls.append(Control(router, may_change))
            self._bind(router, endpoint, key)

    def _bind(self, socket: zmq.Socket[Any], endpoint: str, key: str) -> None:
        """An address that may be had later is tried again; the rest is served meanwhile."""
        binding = Binding(endpoint, key)
        self._bindings.append(binding)
        try:
            binding.let_in(socket)
        except NotNowError as error:
            log.warning("%s; it is tried again each second", error)
            self._unbound.append((binding, socket))

    def _bind_again(self) -> None:
        for waiting in tuple(self._unbound):
            binding, socket = waiting
            with contextlib.suppress(SetupError):
                binding.let_in(socket)
                self._unbound.remove(waiting)
                log.info("%s is bound", binding.name)

    def _make_poller(self) -> None:
        self._poller = zmq.Poller()
        self._poller.register(self._end.fileno(), zmq.POLLIN)
        controls = self._controls if self._is_at_work else ()
        robot = self._robot if self._robot is not None and self._robot.is_awaited else None
        for owner in (*self._streams, *controls, robot, self._admission):
            if owner is not None:
                self._poller.register(owner.socket, zmq.POLLIN)
        if self._array is not None:
            self._poller.register(self._array.socket, zmq.POLLIN)

    def _close_all(self) -> None:
        heard = self._robot, self._array
        for owner in (*self._streams, *self._controls, *heard, self._admission, *self._bindings):
            if owner is not None:
                owner.close()


class _ToLoop(logging.Handler):
    """A handler that sends each record to the loop, which has the log."""

    def __init__(self, end: socket.socket) -> None:
        super().__init__()
        self._end = end

    def emit(self, record: logging.LogRecord) -> None:
        line = pair.printable(record.getMessage())
        with contextlib.suppress(OSError):
            pair.send(self._end, Kind.LOG, record.levelno, line)


def main() -> None:
    """`python -m taxeld.door DESCRIPTOR SETTINGS`, the door's end of the pair."""
    for number in (signal.SIGINT, signal.SIGTERM):  # of a terminal, of a service that stops
        signal.signal(number, signal.SIG_IGN)  # the loop ends the door when it has ended
    end = socket.socket(fileno=int(sys.argv[1]))
    log.addHandler(_ToLoop(end))
    log.setLevel(logging.INFO)
    limits.limit()
    try:
        door = Door(Settings.parse(sys.argv[2]), end)
    except SetupError as error:
        pair.send(end, Kind.FAULT, pair.printable(str(error)))
        sys.exit(2)
    try:
        door.run()
    finally:
        door.close()


def _keys(settings: Settings) -> _Keys:
    """Raises SetupError where a key that is needed cannot be used."""
    served = (*settings.relay_publish, settings.relay_control)
    return _Keys(
        curve.robot_keys(settings.keys, settings.robot), curve.relay_keys(settings.keys, served)
    )
