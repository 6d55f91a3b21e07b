"""A door as the daemon starts it, a process of its own, and the loop's end in the test's hands."""

import contextlib
import os
import select
import socket as kernel
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import msgpack
import zmq

from taxeld.door.settings import Settings
from taxeld.prior import PosePrior
from taxeld.service.doorkeeper import Doorkeeper
from taxeld.stream import client
from taxeld.stream.link import Link

from ..rig.clocks import PATIENCE_S, until
from ..rig.processes import free_port
from ..rig.sockets import Sockets

INFO = {"taxeld": "0"}
QUEUE = 60
ANYWHERE = "0.0.0.0"  # noqa: S104
NOBODY = 65_534
needs_root = os.geteuid() != 0, "only root can be another user"


class Loop:
    """The loop's part: a link, and what was done by what doors said."""

    def __init__(self, relay: bool = False) -> None:
        self.poses: list[tuple[Any, ...]] = []  # (t, x, y, θ, when it came, link)
        self.done: list[str] = []
        changes: dict[str, Any] = {
            name: partial(self.done.append, name) for name in ("tare", "reset")
        }
        self.priors: list[PosePrior] = []
        changes |= {"prior": self._prior, "fail": partial(divmod, 1, 0)}
        given = INFO, lambda *pose: self.poses.append(pose), changes
        self.link = Link(*given, Link(*given) if relay else None)

    def _prior(self, **given: Any) -> str:
        pose = PosePrior(**given)
        self.priors.append(pose)
        return "" if pose.object != "cup" else "no object cup"


class Stand(Sockets, Loop):
    """A door that serves a stream and control in a directory."""

    def __init__(self, place: Path, **settings: Any) -> None:
        Sockets.__init__(self)
        Loop.__init__(self, relay=True)
        self.stream, self.control = f"ipc://{place}/stream", f"ipc://{place}/control"
        served = {"publish": (self.stream,), "control": self.control, "queue": QUEUE} | settings
        own = [key for key in served if key.startswith("relay_")]  # of the relay
        relay = {key.removeprefix("relay_"): served.pop(key) for key in own}
        self.other = "".join(relay.get("publish", ())[:1])
        relay |= {"is_relay": True, "queue": QUEUE, "keys": served.get("keys", "")}
        self.keeper, self.relay = (Doorkeeper(Settings(**each)) for each in (served, relay))
        self.keepers = [self.keeper, self.relay]
        self._next_estimate_s = 0.0
        self.sent = 0
        for keeper in self.keepers:
            self.callback(keeper.close)
        try:
            for keeper, link in zip(self.keepers, self.link.doors, strict=True):
                keeper.wait(link)
        except BaseException:
            self.close()
            raise

    @property
    def pid(self) -> int:
        return pid(self.keeper)

    def look(self) -> None:
        """As the loop does: an estimate twenty times a second, and a look at the door."""
        now_s = time.monotonic()
        if now_s >= self._next_estimate_s:
            self._next_estimate_s = now_s + 0.05
            self.sent += 1
            self.link.send(b"/taxeld/estimate", {"seq": self.sent}, 1.0)
        for keeper in self.keepers:
            keeper.look(now_s)

    def until(self, holds: Callable[[], object]) -> None:
        until(holds, self.look)

    def socket(self, kind: int, endpoint: str = "", **options: int) -> zmq.Socket[Any]:
        made = self.open(kind)
        for name, value in options.items():
            made.setsockopt(getattr(zmq, name), value)
        if endpoint:
            made.connect(endpoint)
        return made

    def losses(self, socket: zmq.Socket[Any]) -> zmq.Socket[Any]:
        """Readable once the socket has lost its connection."""
        return self.keep(socket.get_monitor_socket(zmq.EVENT_DISCONNECTED))

    def listener(self, *topics: bytes, endpoint: str = "", **options: int) -> zmq.Socket[Any]:
        made = self.socket(zmq.SUB, **options)
        for topic in topics:
            made.setsockopt(zmq.SUBSCRIBE, topic)
        made.connect(endpoint or self.stream)
        return made

    def received(self, socket: zmq.Socket[Any]) -> list[bytes]:
        """The next message of a socket."""
        self.until(lambda: socket.poll(0))
        return socket.recv_multipart()

    def answer(self, request: object, endpoint: str = "", **options: int) -> dict[str, Any]:
        asking = self.socket(zmq.REQ, endpoint or self.control, **options)
        asking.send(msgpack.packb(request))
        return msgpack.unpackb(self.received(asking)[0])  # type: ignore[no-any-return]

    def asked_by_client(self, command: str, endpoint: str) -> dict[str, Any]:
        """What the command line's client is answered."""
        with ThreadPoolExecutor() as threads:
            asked = threads.submit(client.ask, endpoint, command, PATIENCE_S)
            self.until(asked.done)
            return asked.result() or {}

    def asked_by_another(self, command: str, groups: Sequence[int]) -> dict[str, Any]:
        """What another user's process is answered, one of these groups."""
        own, its = kernel.socketpair()
        with own, its:
            if not os.fork():
                with contextlib.suppress(BaseException):
                    os.setgroups(groups)
                    os.setgid(NOBODY)
                    os.setuid(NOBODY)
                    its.send(msgpack.packb(client.ask(self.control, command, PATIENCE_S)))
                os._exit(0)
            self.until(lambda: select.select([own], [], [], 0)[0])
            os.wait()
            return msgpack.unpackb(own.recv(65_536))  # type: ignore[no-any-return]

    def send_until(
        self, holds: Callable[[], object], socket: zmq.Socket[Any], *frames: bytes
    ) -> None:
        """Send a message again and again until something holds."""

        def held() -> object:
            socket.send_multipart(frames)
            return holds()

        self.until(held)

    def until_bound(self, socket: zmq.Socket[Any], endpoint: str) -> None:
        """Where another socket has just been closed."""

        def bound() -> bool:
            try:
                socket.bind(endpoint)
            except zmq.ZMQError:
                return False
            return True

        self.until(bound)


def pid(keeper: Doorkeeper) -> int:
    """Of the door that is there."""
    return keeper._process.pid  # type: ignore[union-attr]


def seq(parts: list[bytes]) -> int:
    """The number of an estimate; 0 of another message."""
    return int(msgpack.unpackb(parts[1]).get("seq", 0))


def robots_endpoint(host: str = "127.0.0.1") -> str:
    """Of a robot on this machine; by `ANYWHERE` it takes keys, which loopback does not."""
    return f"tcp://{host}:{free_port()}"


def pose(x: float) -> list[bytes]:
    """A message of the robot."""
    body = msgpack.packb({"t": 1.0, "x": x, "y": 0.0, "theta": 0.0})
    return [b"/robot/sensor_pose", body, b"1.0"]


def open_to_all(place: Path) -> None:
    """The socket files in a directory of a test, to every user."""
    for directory in (place, *place.parents):
        if directory.is_relative_to(tempfile.gettempdir()) and directory.name != "tmp":
            directory.chmod(0o755)
    for name in ("stream", "control"):
        (place / name).chmod(0o666)
