"""The process: it waits for the loop and for all peers at once, and lives as long as the pair."""

import contextlib
import json
import logging
import os
import signal
import socket
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import msgpack
import zmq

from taxeld.config import endpoints
from taxeld.door import settings as limits
from taxeld.door.binding import NotNowError, bound
from taxeld.door.control import Control, for_all, for_members, packed_error, packed_ok
from taxeld.door.heard import Array, Pose, Robot
from taxeld.door.settings import REFUSED, Settings
from taxeld.door.streams import Streams
from taxeld.errors import SetupError
from taxeld.stream import curve, pair
from taxeld.stream.curve import Keys
from taxeld.stream.link import Report
from taxeld.stream.pair import Kind
from taxeld.stream.topics import ESTIMATE, HEALTH, INFO
from taxeld_protocol.array import ArrayFrame

WAIT_MS = 100  # for a peer or the loop
LOOK_S, REPORT_S = 0.1, 1.0
PACKETS_PER_LOOK = 256
SILENT_S = 2.0  # without an estimate for so long, the loop hangs
NOTHING = b"\x80"  # an empty map
DOMAIN = "taxeld"  # of ZAP: where keys are taken
AGAIN = "it is tried again each second"
BY_IPC, OVER_TCP = ("publish.endpoints", "control.endpoint"), ("relay.publish", "relay.control")

Named = tuple[zmq.Socket[Any], str, str]  # with its endpoint, and their key


class Admission:
    """Lets in who holds the secret of an authorised key; pyzmq answers ZeroMQ's questions in a
    thread of its own."""

    def __init__(self, context: zmq.Context[Any], keys: Keys) -> None:
        from zmq.auth.thread import ThreadAuthenticator  # noqa: PLC0415  (7 MB of asyncio)

        self.refused = 0  # connections without an authorised key
        self._keys = keys
        self._authenticator = ThreadAuthenticator(context)
        self._authenticator.configure_curve_callback(DOMAIN, self)
        self._authenticator.start()
        self.close = self._authenticator.stop

    def callback(self, _: str, key: bytes) -> bool:
        """Whether the holder of a public key may connect; called by the authenticator's thread."""
        is_known = key in self._keys.clients
        self.refused += not is_known
        return is_known

    def guard(self, socket: zmq.Socket[Any]) -> None:
        """Only those who hold a client's key may connect to `socket`."""
        socket.setsockopt(zmq.CURVE_SERVER, 1)
        socket.setsockopt(zmq.CURVE_SECRETKEY, self._keys.secret)
        socket.setsockopt(zmq.ZAP_DOMAIN, DOMAIN.encode())


class Door:
    """All endpoints of a configuration, being served."""

    def __init__(self, settings: Settings, end: socket.socket) -> None:
        """`end`: of the pair."""
        self._settings, self._end = settings, end
        self._report = Report()
        self._latest: dict[bytes, bytes] = {}
        self._state: dict[str, bytes] = {}
        self._estimate_s = time.monotonic()
        self._wanted: set[bytes] | None = None
        self._memory = b""
        self._next_look_s = self._next_report_s = 0.0
        self._context: zmq.Context[Any] = zmq.Context()
        self._bound = contextlib.ExitStack()
        self._admission: Admission | None = None
        self._streams: list[Streams] = []
        self._controls: list[Control] = []
        self._heard: list[Robot | Array] = []
        self._robot: Robot | None = None
        self._awaited: list[Streams | Control | Robot | Array] | None = None  # as the poller has
        self._poller = zmq.Poller()
        self._served: dict[Named, Callable[[], bool]] = {}  # whether newcomers can come
        self._unbound: list[Named] = []  # are tried again

    def open(self) -> None:
        """Open all sockets.

        Raises:
            SetupError: an endpoint or a key cannot be used.
        """
        settings, context = self._settings, self._context
        served = (*settings.publish, settings.control)
        keys = curve.read_keys(settings.keys, settings.robot, served)
        if keys is not None and keys.clients:
            self._admission = Admission(context, keys)
        stream_key, control_key = OVER_TCP if settings.is_relay else BY_IPC
        for endpoint in settings.publish:
            self._streams.append(Streams(context, settings.queue))
            self._serve(self._streams[-1].socket, endpoint, stream_key)
        if settings.control:
            answers = {"status": self._on_status, "info": self._on_info, "memory": self._on_memory}
            may_change = for_members(settings.change_group)
            if settings.is_relay:
                may_change = for_all(settings.change)
            self._controls.append(Control(context, answers, self._pass_on, may_change))
            self._serve(self._controls[-1].socket, settings.control, control_key)
        if settings.robot:
            self._robot = Robot(context, settings.robot, self._on_poses, keys, settings.topics)
            self._report.robot = self._robot.line
            self._heard.append(self._robot)
        if settings.array:
            array = Array(context, settings.array, self._on_array)
            self._report.array = array.line
            self._heard.append(array)
        limits.start_no_more()

    def run(self) -> None:
        """Serve until the loop is gone."""
        with contextlib.suppress(EOFError, ConnectionError):
            pair.send(self._end, Kind.READY)
            while True:
                self._pass()

    def close(self) -> None:
        if self._admission is not None:
            self._admission.close()
        self._context.destroy(linger=0)
        self._bound.close()

    def _serve(self, socket: zmq.Socket[Any], endpoint: str, key: str) -> None:
        """A TCP address that may be had later is tried again; the rest is served meanwhile."""
        if self._admission is not None and curve.takes_keys(endpoint):
            self._admission.guard(socket)
        endpoints.make_directory(endpoint)
        try:
            self._bind(socket, endpoint, key)
        except NotNowError as error:
            if not endpoint.startswith(endpoints.TCP):
                raise
            self._log(logging.WARNING, f"{error}; {AGAIN}")
            self._unbound.append((socket, endpoint, key))

    def _bind(self, *named: *Named) -> None:
        self._served[named] = self._bound.enter_context(bound(*named))

    def _pass(self) -> None:
        # requests wait for the loop's first estimate
        controls = self._controls if ESTIMATE in self._latest else ()
        peers = [p for p in (*self._streams, *controls, *self._heard) if p.is_awaited]
        if peers != self._awaited:
            self._awaited, self._poller = peers, zmq.Poller()
            self._poller.register(self._end, zmq.POLLIN)
            for peer in peers:
                self._poller.register(peer.socket, zmq.POLLIN)
        ready = dict(self._poller.poll(WAIT_MS))
        now_s = time.monotonic()
        if self._end.fileno() in ready:
            self._take_from_loop(now_s)
        for peer in peers:
            if peer.socket in ready:
                peer.poll(now_s)
        if now_s >= self._next_look_s or any(stream.socket in ready for stream in self._streams):
            self._next_look_s = now_s + LOOK_S
            self._look(now_s)

    def _look(self, now_s: float) -> None:
        """Do the work that need not be done in each pass."""
        for control in self._controls:
            control.look(now_s)
        for heard in self._heard:
            heard.poll(now_s)
            heard.look(now_s)
        if INFO in self._latest:
            info = [INFO, self._latest[INFO], b"%.6f" % time.time()]
            for stream in self._streams:
                stream.greet(now_s, info)
        wanted = set[bytes]().union(*(stream.wanted for stream in self._streams))
        if wanted != self._wanted and pair.send(self._end, Kind.WANTED, sorted(wanted)):
            self._wanted = wanted
        if now_s >= self._next_report_s:
            self._next_report_s = now_s + REPORT_S
            self._bind_again()
            self._report.keys_refused = self._admission.refused if self._admission else 0
            self._report.unbound = len(self._unbound)
            pair.send(self._end, Kind.REPORT, asdict(self._report))

    def _bind_again(self) -> None:
        removed = [named for named, serves in self._served.items() if not serves()]
        for named in removed:
            del self._served[named]
            self._log(logging.WARNING, f"{named[2]}: {named[1]} was removed; {AGAIN}")
        self._unbound += removed
        for waiting in tuple(self._unbound):
            _, endpoint, key = waiting
            with contextlib.suppress(SetupError):
                self._bind(*waiting)
                self._unbound.remove(waiting)
                self._log(logging.INFO, f"{key}: {endpoint} is bound")

    def _take_from_loop(self, now_s: float) -> None:
        for _ in range(PACKETS_PER_LOOK):
            packet = pair.receive(self._end)
            if packet is None:
                return
            self._take(now_s, *packet)

    def _take(self, now_s: float, kind: int, values: list[Any]) -> None:
        match kind, values:
            case Kind.MESSAGE, [topic, t, body]:
                self._forward(now_s, topic, body, t)
            case Kind.STATE, [state]:
                self._state = {name: msgpack.packb(value) for name, value in state.items()}
            case Kind.MEMORY, [scans]:
                self._memory = msgpack.packb(scans)
            case Kind.ANSWER, [number, why]:
                for control in self._controls:
                    control.done(number, why)
            case Kind.ASK, [also_next] if self._robot is not None:
                self._robot.poll(now_s, is_asked=True)
                self._robot.is_awaited = also_next

    def _forward(self, now_s: float, topic: bytes, body: bytes, t: float) -> None:
        self._latest[topic] = body
        if topic == ESTIMATE:
            self._estimate_s = now_s
        is_for_all = self._settings.estimates or topic != ESTIMATE  # else it is for `status`
        if is_for_all and topic != INFO:  # newcomers are greeted with that
            for stream in self._streams:
                stream.send((topic, body, b"%.6f" % t))

    def _log(self, level: int, line: str) -> None:
        """To the loop, which has the log."""
        pair.send(self._end, Kind.LOG, level, pair.printable(line))

    def _on_poses(self, poses: list[list[Pose]], is_answer: bool) -> None:
        pair.send(self._end, Kind.POSES, poses, is_answer, time.time())

    def _on_array(self, frame: ArrayFrame) -> None:
        if self._robot is not None:  # a scan is placed by the poses before it
            self._robot.poll(time.monotonic())
        pair.send(self._end, Kind.ARRAY, frame.t, frame.id, frame.rest, frame.counts)

    def _pass_on(self, number: int, command: str, arguments: dict[str, Any]) -> bool:
        return pair.send(self._end, Kind.CHANGE, number, command, arguments)

    def _on_status(self) -> bytes:
        now_s = time.monotonic()
        if now_s > self._estimate_s + SILENT_S:  # or this door was slow
            self._take_from_loop(now_s)
        if now_s > self._estimate_s + SILENT_S:
            return packed_error("the loop is silent; the log of the daemon may say why")
        latest = {"estimate": self._latest[ESTIMATE], "health": self._latest.get(HEALTH, NOTHING)}
        return packed_ok(**latest, **self._state)

    def _on_memory(self) -> bytes:
        if not self._memory:
            return packed_error("nothing was felt yet: touch the object first")
        return packed_ok(memory=self._memory)

    def _on_info(self) -> bytes:
        return packed_ok(info=self._latest[INFO])


def main() -> None:
    """`python -m taxeld.door.process DESCRIPTOR SETTINGS`; the descriptor is of the pair."""
    for number in (signal.SIGINT, signal.SIGTERM):  # of a terminal, of a service that stops
        signal.signal(number, signal.SIG_IGN)  # the loop ends the door when it has ended
    end = socket.socket(fileno=int(sys.argv[1]))
    limits.limit()
    door, status = Door(Settings(**json.loads(sys.argv[2])), end), 0
    try:
        door.open()
        door.run()
    except SetupError as error:
        with contextlib.suppress(OSError):
            pair.send(end, Kind.FAULT, pair.printable(str(error)))
        status = REFUSED
    finally:
        door.close()
    os._exit(status)  # at once: the loop kills a door that has closed its end of the pair


if __name__ == "__main__":
    main()
