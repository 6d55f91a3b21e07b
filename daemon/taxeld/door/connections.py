"""The connections of this process, as the kernel has them: who holds too many places, who sends
without end, and how much waits for each.

ZeroMQ says nothing of these. It keeps the frames of a message until the last of them has come,
however many they are; that shows in the memory of the process, and the kernel knows who is sending.
"""

import ctypes
import fcntl
import math
import os
import socket
import stat
import struct
import termios
from collections import Counter
from collections.abc import Iterable, Set
from dataclasses import dataclass

from taxeld.config import endpoints
from taxeld.stream.sockets import borrowed, credentials

MEMORY_S = 0.01  # at least, between looks while memory does not grow
NOTICED_BYTES = 4 << 20  # growth from which memory is looked at all the time
GROWTH_BYTES = 32 << 20  # growth of memory after which senders are hung up on
OWN_S = 1.0  # where nobody was sending while memory grew for so long, it is the door's own
SEND_BYTES = 32_768  # buffer of a slow subscriber in the kernel, which doubles it
PEERS_MAX = 384  # connections
PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


@dataclass(frozen=True, slots=True)
class Connection:
    """An accepted connection."""

    number: int  # number of its descriptor
    user: int  # numeric id; of TCP none is known, -1


class Connections:
    """The connections of the endpoints that are served, and those to robot and array."""

    def __init__(self, served: Iterable[str], heard: Iterable[str]) -> None:
        """To be made before the process is confined: it keeps its places in /proc open."""
        self.hoarders = self.crowded_out = 0
        self.there: dict[int, Connection] = {}  # accepted ones, by inode
        self._places = {_place(endpoint) for endpoint in served}
        self._heard = {_place(endpoint) for endpoint in heard}
        self._listing = os.open("/proc/self/fd", os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        self._memory = os.open("/proc/self/statm", os.O_RDONLY | os.O_CLOEXEC)
        self._least = self._own_s = math.inf
        self._next_memory_s = -math.inf
        self._strangers: Set[int] = set()  # inodes of sockets that are not accepted connections

    def close(self) -> None:
        os.close(self._listing)
        os.close(self._memory)

    def survey(self) -> None:
        """Find who has come and gone, and make room where too many are there."""
        sockets = self._sockets()
        self.there = {inode: peer for inode, peer in self.there.items() if inode in sockets}
        self._strangers = self._strangers & sockets.keys()
        for inode in sockets.keys() - self.there.keys() - self._strangers:
            peer = self._accepted(sockets[inode])
            if peer is None:
                self._strangers |= {inode}
            else:
                self.there[inode] = peer
        for _ in range(len(self.there) - PEERS_MAX):
            self._make_room()

    def _make_room(self) -> None:
        """Hang up on the newest of the user who has most; root and the own user come last."""
        held = Counter(peer.user for peer in self.there.values())
        spared = {0, os.geteuid()}
        user = max(held, key=lambda user: (user not in spared, held[user]))
        inode, peer = next(i for i in reversed(self.there.items()) if i[1].user == user)
        del self.there[inode]
        self.crowded_out += _hang_up(peer.number)

    def is_calm(self, now_s: float) -> bool:
        """Whether memory does not grow; whoever makes it grow by too much is hung up on. `now_s` is
        monotonic."""
        if now_s < self._next_memory_s:
            return True
        resident = int(os.pread(self._memory, 100, 0).split()[1]) * PAGE_BYTES
        self._least = min(self._least, resident)
        if resident < self._least + NOTICED_BYTES:
            self._next_memory_s, self._own_s = now_s + MEMORY_S, math.inf
            return True
        if resident >= self._least + GROWTH_BYTES:
            found = sum(map(self._hang_up_on_sender, self._sockets().values()))
            self.hoarders += found
            ctypes.CDLL(None).malloc_trim(0)
            if found:
                self._own_s = math.inf
        self._own_s = min(self._own_s, now_s + OWN_S)
        if now_s >= self._own_s:
            self._least = resident
        return False

    def _hang_up_on_sender(self, number: int) -> bool:
        """Whether the descriptor is a connection to one of our endpoints, or to robot or array,
        that has more to read."""
        try:
            with borrowed(number) as connection:
                if not self._is_ours(connection):
                    return False
                unread = fcntl.ioctl(connection, termios.FIONREAD, bytes(4))
                if not struct.unpack("i", unread)[0]:
                    return False
                connection.shutdown(socket.SHUT_RDWR)
        except OSError:  # it listens, or is there no more
            return False
        return True

    def _is_ours(self, connection: socket.socket) -> bool:
        if _name(connection.getsockname()) in self._places:
            return True
        return bool(self._heard) and _name(connection.getpeername()) in self._heard

    def _accepted(self, number: int) -> Connection | None:
        """The connection of a descriptor, whose kernel queue is bounded; None: it is another."""
        try:
            with borrowed(number) as connection:
                if _name(connection.getsockname()) not in self._places:
                    return None
                connection.getpeername()  # a socket that listens has none
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BYTES)
                user = -1
                if connection.family == socket.AF_UNIX:
                    user = credentials(connection)[1]
        except OSError:
            return None
        return Connection(number, user)

    def _sockets(self) -> dict[int, int]:
        """All of this process: inode → descriptor."""
        found = {}
        for name in os.listdir(self._listing):  # noqa: PTH208  (a descriptor)
            try:
                about = os.fstat(int(name))
            except OSError:  # the listing's own, closed by now
                continue
            if stat.S_ISSOCK(about.st_mode):
                found[about.st_ino] = int(name)
        return found


def _hang_up(number: int) -> bool:
    try:
        with borrowed(number) as connection:
            connection.shutdown(socket.SHUT_RDWR)
    except OSError:
        return False
    return True


def _place(endpoint: str) -> object:
    """The kernel's name of an endpoint: a path, or a port alone."""
    path = endpoints.ipc_path(endpoint)
    return str(path) if path is not None else int(endpoint.rpartition(":")[2])


def _name(address: object) -> object:
    return address[1] if isinstance(address, tuple) else address
