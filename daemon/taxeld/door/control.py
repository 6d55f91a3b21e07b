"""Requests and their answers: msgpack {"cmd": …} → {"ok": bool, …}.

`status`, `info` and `memory` are answered by what the loop has handed over; `tare`, `reset` and
`prior` are passed on to it, for those who may.
"""

import contextlib
import grp
import itertools
import os
import socket as kernel
import struct
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any, NamedTuple

import msgpack
import zmq

from taxeld.prior import read_prior
from taxeld.stream.sockets import is_waiting, open_socket, unpack

REQUESTS_AT_ONCE = 64
REQUEST_BYTES = 4096
QUEUED = 16  # requests and answers of a client
PRIOR = "prior"
CHANGES = ("tare", "reset", PRIOR)
CHANGE_S = 2.0  # without the loop's answer for so long, the client is told
SO_PEERGROUPS = 59
CREDENTIALS = struct.Struct("3i")  # process, user and group
GROUPS_BYTES = 1024  # getsockopt of Python gives no more: 256 groups

NUMBERS = itertools.count(1)  # numbers of the changes, of all endpoints

Answers = Mapping[str, Callable[[], bytes]]
MayChange = Callable[[zmq.Frame], str]  # a frame of the peer → why it may not, or an empty text
Change = Callable[[int, str, dict[str, Any]], bool]
"""Number, command and arguments → whether it was passed on."""


class _Pending(NamedTuple):
    """A change that the loop has not answered."""

    number: int
    until_s: float
    route: list[bytes]


class Control:
    """Serves one endpoint by a ROUTER: with REP a client that breaks off would wedge it.

    One change at a time is passed on; requests that come meanwhile wait for its answer.
    """

    def __init__(
        self, context: zmq.Context[Any], answers: Answers, change: Change, may_change: MayChange
    ) -> None:
        """`answers` by command; `may_change`: why the peer that sent a frame may not change
        anything, empty where it may."""
        self.socket = open_socket(
            context, zmq.ROUTER, send=QUEUED, receive=QUEUED, largest=REQUEST_BYTES
        )
        self._answers, self._change, self._may_change = answers, change, may_change
        self._pending: _Pending | None = None

    @property
    def is_awaited(self) -> bool:
        """Whether requests are taken now."""
        return self._pending is None

    def poll(self, now_s: float) -> None:
        """Answer requests that have come; `now_s` is monotonic."""
        for _ in range(REQUESTS_AT_ONCE):
            if self._pending is not None or not is_waiting(self.socket):
                return
            *frames, body = self.socket.recv_multipart(zmq.NOBLOCK, copy=False)
            route = [frame.bytes for frame in frames]
            answer = self._answer(now_s, route, body)
            if answer is not None:
                self._send(route, answer)

    def done(self, number: int, why: str) -> None:
        """The loop's answer to the change of that number; `why` it was not done."""
        if self._pending is not None and self._pending.number == number:
            route, self._pending = self._pending.route, None
            self._send(route, packed_error(why) if why else packed_ok())

    def look(self, now_s: float) -> None:
        """Tell who waits for a loop that does not answer."""
        if self._pending is not None and now_s > self._pending.until_s:
            why = "the loop does not answer; the log of the daemon may say why"
            self.done(self._pending.number, why)

    def _answer(self, now_s: float, route: list[bytes], body: zmq.Frame) -> bytes | None:
        """None where the loop is to answer."""
        request = unpack(body.bytes)
        command = request.pop("cmd", None)
        if not isinstance(command, str) or command not in (*self._answers, *CHANGES):
            known = ", ".join((*self._answers, *CHANGES))
            return packed_error(f"unknown cmd {command!r:.100}; known: {known}")
        arguments: dict[str, Any] = {}
        if command == PRIOR:
            prior = read_prior(request)
            if isinstance(prior, str):
                return packed_error(f"prior: {prior}")
            arguments = asdict(prior)
        elif request:
            return packed_error(f"unknown key {next(iter(request))!r:.100}; {command} takes none")
        if command in self._answers:
            return self._answers[command]()
        refusal = self._may_change(body)
        if refusal:
            return packed_error(f"{command}: {refusal}")
        number = next(NUMBERS)
        if not self._change(number, command, arguments):
            return packed_error("the loop is busy; ask again")
        self._pending = _Pending(number, now_s + CHANGE_S, route)
        return None

    def _send(self, route: list[bytes], answer: bytes) -> None:
        """The envelope goes back as it came; a client that fetches no answers loses them."""
        with contextlib.suppress(zmq.ZMQError):
            self.socket.send_multipart([*route, answer], flags=zmq.NOBLOCK)


def packed_ok(**parts: bytes) -> bytes:
    """An answer of maps that are packed already."""
    packer = msgpack.Packer()
    head: bytes = packer.pack_map_header(1 + len(parts)) + packer.pack("ok") + packer.pack(True)
    return head + b"".join(packer.pack(name) + body for name, body in parts.items())


def packed_error(error: str) -> bytes:
    made: bytes = msgpack.packb({"ok": False, "error": error})
    return made


def for_all(change: bool) -> MayChange:
    """Over TCP everybody may change something, or nobody."""
    return lambda _: "" if change else "not over TCP: relay.change is false"


def for_members(group: str) -> MayChange:
    """Who may change something at an ipc endpoint: root, the daemon's own user, and members of the
    group, as the kernel knew them when they connected. The function gives the reason for a refusal
    of the peer that sent a frame, empty where there is none."""
    try:
        number = grp.getgrnam(group).gr_gid
        refusal = (
            f"is for members of the group {group}: sudo usermod -aG {group} USER, and log in again"
        )
    except KeyError:
        number, refusal = -1, f"is for the daemon's own user, as there is no group {group} here"

    def why_not(frame: zmq.Frame) -> str:
        option, level = kernel.SO_PEERCRED, kernel.SOL_SOCKET
        try:
            descriptor = int(frame.get(zmq.SRCFD))
            with kernel.fromfd(descriptor, kernel.AF_UNIX, kernel.SOCK_STREAM) as peer:
                made = CREDENTIALS.unpack(peer.getsockopt(level, option, CREDENTIALS.size))
                found = peer.getsockopt(level, SO_PEERGROUPS, GROUPS_BYTES)
        except (OSError, zmq.ZMQError):
            return refusal
        process, user, own_group = made
        if frame.get("Peer-Address") != f"localhost:{user}:{own_group}:{process}":
            return refusal  # ZeroMQ has closed the connection, and this is another one
        groups = {own_group, *struct.unpack(f"{len(found) // 4}I", found)}
        return "" if user in (0, os.geteuid()) or number in groups else refusal

    return why_not
