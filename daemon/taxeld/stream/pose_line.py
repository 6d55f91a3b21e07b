"""The line to the robot: whether it stands, and what comes over it that is no pose.

Only while no pose comes, a socket of its own listens for a moment to all that the robot publishes.
"""

import itertools
import struct
from collections.abc import Callable
from typing import Any

import zmq

from taxeld.stream import messages, sockets

EVENTS_PER_LOOK = 64
MESSAGES_PER_LOOK = 8
LISTEN_LOOKS = 3  # to what else comes, of so many looks
PAUSE_LOOKS = 30  # before it is listened to again
TOPICS_MAX = 4
TOPIC_CHARACTERS = 60
FAILED = (
    zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_AUTH
)
GONE = zmq.EVENT_DISCONNECTED | zmq.EVENT_CLOSED
# Of a monitor, an event and its value: pyzmq's own reader brings all of asyncio
EVENT = struct.Struct("=HI")
NUMBERS = itertools.count()  # each monitor has a name of its own
WATCHED = zmq.EVENT_CONNECTED | zmq.EVENT_HANDSHAKE_SUCCEEDED | GONE | FAILED


class PoseLine:
    """What is known of the connection of a SUB socket, looked at once a second."""

    def __init__(
        self,
        context: zmq.Context[Any],
        listener: Callable[[bytes], zmq.Socket[Any]],
    ) -> None:
        """`listener`: another socket like it, which subscribes to a topic."""
        self.is_connected = False
        self.is_refused = False  # connected, and the handshake fails
        self.topics: list[str] = []  # others, heard of late
        self._context = context
        self._listener = listener
        self._ear: zmq.Socket[Any] | None = None
        self._looks = 0  # since it was listened last, or since that began
        self._half_open = 0  # looks at a connection without a handshake

    def follow(self, socket: zmq.Socket[Any]) -> None:
        """Watch this one, which is not connected yet; the one before has been let go."""
        self._socket = socket
        where = f"inproc://robot-{next(NUMBERS)}"
        socket.monitor(where, WATCHED)
        self._monitor = self._context.socket(zmq.PAIR)
        self._monitor.connect(where)
        self.is_connected, self._half_open = False, 0

    def let_go(self) -> None:
        """The socket is about to be closed."""
        self._socket.monitor(None, 0)
        self._monitor.close(linger=0)

    def look(self, *, has_poses: bool) -> None:
        """Take what has happened; without poses find out what comes in their place."""
        for _ in range(EVENTS_PER_LOOK):
            if not sockets.is_waiting(self._monitor):
                break
            self._take(EVENT.unpack(self._monitor.recv_multipart()[0])[0])
        if self._half_open:
            self._half_open += 1
            self.is_refused |= self._half_open > LISTEN_LOOKS
        if has_poses or not self.is_connected:
            self._stop_listening()
            self.topics = []
        else:
            self._listen()

    def close(self) -> None:
        self._stop_listening()
        self.let_go()

    def _take(self, event: int) -> None:
        if event == zmq.EVENT_HANDSHAKE_SUCCEEDED:
            self.is_connected, self.is_refused, self._half_open = True, False, 0
        elif event == zmq.EVENT_CONNECTED:
            self._half_open = max(self._half_open, 1)
        elif event & FAILED:
            self.is_connected, self.is_refused = False, True
        elif event == zmq.EVENT_CLOSED:  # it could not connect: nobody is there
            self.is_connected, self.is_refused, self._half_open = False, False, 0
        else:
            self.is_connected = False

    def _listen(self) -> None:
        self._looks += 1
        if self._ear is None:
            if self.topics and self._looks < PAUSE_LOOKS:
                return
            self._ear, self._looks = self._listener(b""), 0
            return
        found = []
        for parts in sockets.messages(self._ear, MESSAGES_PER_LOOK):
            if parts is None:
                self._stop_listening()
                return
            name = parts[0].decode("utf-8", "backslashreplace")[:TOPIC_CHARACTERS]
            if parts[0] != messages.SENSOR_POSE and name not in found:
                found.append(name)
        if found:
            self.topics = found[:TOPICS_MAX]
        if found or self._looks >= LISTEN_LOOKS:
            self._stop_listening()

    def _stop_listening(self) -> None:
        if self._ear is not None:
            self._ear.close()
            self._ear = None
