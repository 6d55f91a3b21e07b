"""Unix sockets of the loop's own, which speak ZMTP: whoever comes is heard and answered within
bounds, and nothing waits.

ZeroMQ's own would end the process where descriptors run out, gather the frames of a message without
end, and hand over what comes as fast as it can be sent, in the loop's time. Here a look takes a few
connections, reads a little of each peer, and takes messages by turns; what is more waits in the
kernel, and in who sends it.
"""

import logging
import math
import resource
import select
import socket as kernel
import struct
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

from taxeld.stream import zmtp
from taxeld.stream.door import Door

ACCEPTS_PER_LOOK = 16
READS_PER_LOOK = 32  # peers
STEPS_PER_LOOK = 64  # messages of all, and commands of the protocol
READ_BYTES = 4096
WRITES_PER_LOOK = 8  # messages of each peer that had to wait
PEERS_MAX = 256
CROWD = 32  # connections of a process; where all are taken, the one with most of them gives way
SPARE = 16  # descriptors that are left to the rest of the daemon
SAY_S = 60.0  # without anybody turned away, after which it is said again
HANDSHAKE_S = 5.0  # who has not said by then who it is, is let go
DOOR_S = 0.2  # between looks at the socket file
IN, OUT, GONE = select.EPOLLIN, select.EPOLLOUT, select.EPOLLHUP | select.EPOLLERR
CREDENTIALS = struct.Struct("3i")  # process, user, group
log = logging.getLogger(__name__)


@dataclass(slots=True)
class PeerCounters:
    """Since start."""

    oversized: int = 0  # peers that sent a larger message than is ours, and were hung up on
    strangers: int = 0  # … that spoke otherwise, or said nothing
    crowded_out: int = 0  # … that had to go, or were not let in, as too many were there
    bound_again: int = 0  # times that the socket file had vanished


class Terms(NamedTuple):
    """What a server is, and what it takes and keeps of a peer."""

    kind: bytes  # of socket, as ZeroMQ names them
    kinds: frozenset[bytes]  # that may talk to it
    largest: int  # bytes of a frame
    frames: int  # of a message
    queue: int  # messages that wait for a slow peer; the next ones are lost


class Peer:
    """A connection."""

    __slots__ = ("connection", "conversation", "events", "number", "pid", "queue", "since_s",
                 "waits")  # fmt: skip

    def __init__(self, connection: kernel.socket, terms: Terms, now_s: float) -> None:
        self.connection = connection
        self.conversation = zmtp.Conversation(terms.kinds, terms.largest, terms.frames)
        self.number = connection.fileno()
        credentials = connection.getsockopt(kernel.SOL_SOCKET, kernel.SO_PEERCRED, CREDENTIALS.size)
        self.pid: int = CREDENTIALS.unpack(credentials)[0]
        self.queue: deque[bytes | memoryview] = deque()
        self.since_s = now_s
        self.events = IN  # that are watched for
        self.waits = False  # what was read holds more messages, perhaps

    def move(self) -> None:
        """To the lowest descriptor that is free: the last ones are not for peers."""
        lower = self.connection.dup()
        self.connection.close()
        self.connection, self.number = lower, lower.fileno()


class Server:
    """One endpoint, and those who are connected to it."""

    def __init__(
        self, endpoint: str, key: str, terms: Terms, counters: PeerCounters,
        on_gone: Callable[[Peer], None] = lambda _: None,
    ) -> None:  # fmt: skip
        """`on_gone` is told of each peer that has been connected and is no more.

        Raises:
            SetupError: the endpoint cannot be had, in the name of `key`.
        """
        self._key = key
        self._terms = terms
        self._hello = zmtp.hello(terms.kind)
        self._counters = counters
        self._on_gone = on_gone
        self._peers: dict[int, Peer] = {}  # by the number of their descriptor
        self._unready: dict[Peer, None] = {}  # those who have not said who they are, oldest first
        self._waiting: OrderedDict[int, deque[Peer]] = OrderedDict()  # by process: each has a turn
        self._next_say_s = self._next_door_s = -math.inf
        self._door = Door(endpoint, key)
        self._epoll = select.epoll()
        self._watch_door()

    def fileno(self) -> int:
        """Readable while somebody comes, speaks or leaves, or can be sent what waits for him."""
        return self._epoll.fileno()

    def look(self, now_s: float, most: int) -> Iterator[tuple[Peer, list[bytes]]]:
        """At most so many messages; `now_s` is monotonic. To be taken to the end."""
        has_callers = False
        for number, events in self._epoll.poll(0, READS_PER_LOOK):
            peer = self._peers.get(number)
            if peer is None:
                has_callers |= number == self._listening
            elif events & GONE:
                self._let_go(peer)
            else:
                if events & OUT:
                    self._flush(peer)
                if events & IN:
                    self._read(peer)
        if has_callers:  # last, as they take the numbers of those who have gone
            self._accept(now_s)
        self._let_go_of_the_silent(now_s)
        yield from self._messages(most)
        if now_s >= self._next_door_s:
            self._next_door_s = now_s + DOOR_S
            if self._door.restore():
                self._counters.bound_again += 1
                self._watch_door()

    def send(self, peer: Peer, data: bytes) -> None:
        """A packed message, which is lost where too many wait for the peer already."""
        if peer.queue:
            if len(peer.queue) < self._terms.queue:
                peer.queue.append(data)
            return
        sent = self._sent(peer, data)
        if sent < len(data):
            peer.queue.append(memoryview(data)[sent:])
            self._watch(peer)

    def hang_up(self, peer: Peer) -> None:
        if self._peers.get(peer.number) is peer:
            self._let_go(peer)

    def close(self) -> None:
        for peer in self._peers.values():
            peer.connection.close()
        self._peers.clear()
        self._epoll.close()
        self._door.close()

    def _watch_door(self) -> None:
        """The one before was closed with its file, and so is watched no more."""
        assert self._door.listening is not None  # noqa: S101  (the endpoint is an ipc one)
        self._listening = self._door.listening.fileno()
        self._epoll.register(self._listening, IN)

    def _accept(self, now_s: float) -> None:
        assert self._door.listening is not None  # noqa: S101
        for _ in range(ACCEPTS_PER_LOOK):
            try:
                connection, _ = self._door.listening.accept()
            except BlockingIOError:
                return
            except OSError as error:
                self._turn_away(now_s, str(error.strerror))
                return
            connection.setblocking(False)
            peer = Peer(connection, self._terms, now_s)
            if self._has_room(peer, now_s):
                self._peers[peer.number] = peer
                self._unready[peer] = None
                self._epoll.register(peer.number, IN)
                self._sent(peer, self._hello)
            else:
                connection.close()

    def _has_room(self, peer: Peer, now_s: float) -> bool:
        """Whether it may come in, be it in another's place."""
        allowed = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        few = allowed != resource.RLIM_INFINITY and peer.number >= allowed - SPARE
        if not few and len(self._peers) < PEERS_MAX:
            return True
        self._turn_away(now_s, "few descriptors are left" if few else "no more are served")
        held = Counter(other.pid for other in self._peers.values())
        pid, count = held.most_common(1)[0] if held else (peer.pid, 0)
        if count <= CROWD or pid == peer.pid:
            return False
        self._let_go(next(p for p in reversed(self._peers.values()) if p.pid == pid))
        peer.move()
        return True

    def _turn_away(self, now_s: float, why: str) -> None:
        self._counters.crowded_out += 1
        if now_s >= self._next_say_s:
            log.warning(
                "%s: %d are connected, and newcomers are turned away (%s)",
                self._key, len(self._peers), why,
            )  # fmt: skip
        self._next_say_s = now_s + SAY_S

    def _let_go_of_the_silent(self, now_s: float) -> None:
        while self._unready:
            oldest = next(iter(self._unready))
            if now_s < oldest.since_s + HANDSHAKE_S:
                return
            self._counters.strangers += 1
            self._let_go(oldest)

    def _read(self, peer: Peer) -> None:
        if peer.waits:  # it is read further when its turn has come
            self._watch(peer)
            return
        try:
            data = peer.connection.recv(READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._let_go(peer)
            return
        peer.conversation.take(data)
        peer.waits = True
        self._waiting.setdefault(peer.pid, deque()).append(peer)

    def _messages(self, most: int) -> Iterator[tuple[Peer, list[bytes]]]:
        """By turns of the processes, and of the connections of each."""
        for _ in range(STEPS_PER_LOOK):
            if most <= 0 or not self._waiting:
                return
            pid, peers = self._waiting.popitem(last=False)
            peer = peers.popleft()
            if self._peers.get(peer.number) is peer:
                message = self._next_of(peer)
                if message is not None:
                    peers.append(peer)
                if message:
                    most -= 1
                    yield peer, message
            if peers:
                self._waiting.setdefault(pid, deque()).extend(peers)

    def _next_of(self, peer: Peer) -> list[bytes] | None:
        """Its next message, an empty one in place of a command; None where it has none."""
        said = peer.conversation
        try:
            message = said.next()
        except zmtp.OversizedError:
            self._counters.oversized += 1
            self._let_go(peer)
            return None
        except zmtp.StrangerError:
            self._counters.strangers += 1
            self._let_go(peer)
            return None
        if said.is_ready:
            self._unready.pop(peer, None)
        if said.answer:
            self.send(peer, said.answer)
            said.answer = b""
        if message is None:
            peer.waits = False
            self._watch(peer)
        return message

    def _sent(self, peer: Peer, data: bytes | memoryview) -> int:
        """How much of it the kernel has taken; nothing is left of it where the peer has gone."""
        try:
            return peer.connection.send(data)
        except BlockingIOError:
            return 0
        except OSError:
            self.hang_up(peer)
            return len(data)

    def _flush(self, peer: Peer) -> None:
        for _ in range(WRITES_PER_LOOK):
            if not peer.queue:
                break
            data = peer.queue.popleft()
            sent = self._sent(peer, data)
            if sent < len(data):
                peer.queue.appendleft(memoryview(data)[sent:])
                break
        self._watch(peer)

    def _watch(self, peer: Peer) -> None:
        """Whether it has gone is always watched for."""
        events = (0 if peer.waits else IN) | (OUT if peer.queue else 0)
        if events != peer.events and self._peers.get(peer.number) is peer:
            self._epoll.modify(peer.number, events)
            peer.events = events

    def _let_go(self, peer: Peer) -> None:
        del self._peers[peer.number]
        self._unready.pop(peer, None)
        peer.queue.clear()
        peer.connection.close()
        self._on_gone(peer)
