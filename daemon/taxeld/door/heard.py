"""A connection to somebody who publishes, by SUB: it is made anew where ZeroMQ would not."""

import itertools
import struct
from typing import Any

import zmq

from taxeld.stream import curve, sockets
from taxeld.stream.curve import RobotKeys
from taxeld.stream.link import PeerLine
from taxeld.stream.sockets import connect, open_socket

MESSAGES_PER_LOOK = 200
QUEUED = 256  # messages, between two looks as well
EVENTS_PER_LOOK = 64
REASON_MAX = 120  # characters of why a message is none
LOST_S = 2.0  # a connection that does not come back by itself in so long is made anew
HALF_OPEN_S = 3.0  # a connection without a handshake for so long is refused
FAILED = (
    zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_AUTH
)
WATCHED = (
    zmq.EVENT_CONNECTED
    | zmq.EVENT_HANDSHAKE_SUCCEEDED
    | zmq.EVENT_DISCONNECTED
    | zmq.EVENT_CLOSED
    | FAILED
)
EVENT = struct.Struct("=HI")  # an event and its value: pyzmq's own reader brings all of asyncio
NUMBERS = itertools.count()  # each monitor has a name of its own


class Heard:
    """One endpoint; who takes its messages is a subclass."""

    topic = b""  # prefix of the messages that are wanted
    largest = 65_536  # bytes of a message
    key = ""  # of the configuration

    def __init__(
        self, context: zmq.Context[Any], endpoint: str, keys: RobotKeys | None = None
    ) -> None:
        """Raises SetupError where the endpoint is none."""
        self.line = PeerLine()
        self._context, self._endpoint, self._keys = context, endpoint, keys
        self._open()

    @property
    def topics(self) -> list[bytes]:
        """Prefixes of the messages that are wanted."""
        return [self.topic]

    def poll(self, now_s: float) -> None:
        """Take the messages that have arrived."""
        for _ in range(MESSAGES_PER_LOOK):
            if not sockets.is_waiting(self.socket):
                break
            self._take(now_s, self.socket.recv_multipart(zmq.NOBLOCK))
        self._pass_on()

    def look(self, now_s: float) -> bool:
        """What has become of the connection, a few times a second; → whether the socket is another
        one now."""
        for _ in range(EVENTS_PER_LOOK):
            if not sockets.is_waiting(self._monitor):
                break
            self._note(EVENT.unpack(self._monitor.recv_multipart()[0])[0], now_s)
        if self._half_open_s is not None and now_s > self._half_open_s + HALF_OPEN_S:
            self.line.refused = True
        if self._lost_s is not None and now_s > self._lost_s + LOST_S:
            # after an error of the protocol ZeroMQ does not connect again by itself
            self._reopen()
            return True
        return False

    def close(self) -> None:
        self.socket.monitor(None, 0)
        self._monitor.close(linger=0)
        self.socket.close()

    def _take(self, now_s: float, parts: list[bytes]) -> None:
        """A message has come."""
        raise NotImplementedError

    def _pass_on(self) -> None:
        """All messages that have come are taken."""

    def _open(self) -> None:
        self.socket = open_socket(
            self._context, zmq.SUB, send=len(self.topics) + 1, receive=QUEUED, largest=self.largest
        )
        # a queue of one would hold only one subscription
        for topic in self.topics:
            self.socket.setsockopt(zmq.SUBSCRIBE, topic)
        if self._keys is not None:
            keys = self._keys
            curve.as_client(self.socket, keys.robot, keys.public, keys.secret)
        where = f"inproc://heard-{next(NUMBERS)}"
        self.socket.monitor(where, WATCHED)
        self._monitor: zmq.Socket[Any] = self._context.socket(zmq.PAIR)
        self._monitor.connect(where)
        self._lost_s: float | None = None  # since when the connection is gone
        self._half_open_s: float | None = None  # since when it is without a handshake
        connect(self.socket, self._endpoint, self.key)

    def _reopen(self) -> None:
        self.close()
        self._open()
        self.line.connected = False

    def _note(self, event: int, now_s: float) -> None:
        line = self.line
        if event == zmq.EVENT_HANDSHAKE_SUCCEEDED:
            line.connected, line.refused = True, False
            self._lost_s = self._half_open_s = None
        elif event == zmq.EVENT_CONNECTED:
            self._half_open_s = now_s if self._half_open_s is None else self._half_open_s
        elif event & FAILED:
            line.connected, line.refused = False, True
            self._lost_s = now_s
        elif event == zmq.EVENT_CLOSED:  # it could not connect: nobody is there
            line.connected = line.refused = False
            self._half_open_s = self._lost_s = None
        else:
            line.connected = False
            self._lost_s = now_s if self._lost_s is None else self._lost_s
