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
from typing import Any

import msgpack
import zmq

from taxeld.prior import read_prior
from taxeld.stream.sockets import credentials, is_waiting, open_socket, sender, unpack

REQUESTS_AT_ONCE = 64
REQUEST_BYTES = 4096
QUEUED = 16  # requests and answers of a client
PRIOR = "prior"
CHANGES = ("tare", "reset", PRIOR)
PENDING_MAX = 64  # changes that the loop has not answered
PENDING_S = 2.0  # without the loop's answer for so long, the client is told
SO_PEERGROUPS = 59
GROUPS_BYTES = 1024  # getsockopt of Python gives no more: 256 groups

NUMBERS = itertools.count(1)  # numbers of the requests that the loop answers, of all endpoints

Body = bytes
MayChange = Callable[[zmq.Frame], str]  # a frame of the peer → why it may not, or an empty text
Change = Callable[[int, str, dict[str, Any]], bool]
"""Request, command and arguments → whether it was passed on."""


class Control:
    """Serves one endpoint by a ROUTER: with REP a client that breaks off would wedge it."""

    def __init__(self, socket: zmq.Socket[Any], may_change: MayChange) -> None:
        """`socket`: from `open_router`; `may_change`: why the peer that sent a frame may not change
        anything, empty where it may."""
        self.socket, self._may_change = socket, may_change
        self._pending: dict[int, tuple[float, list[bytes]]] = {}  # since when, and for whom

    def poll(self, now_s: float, answers: Mapping[str, Callable[[], Body]], change: Change) -> None:
        """Answer requests that have come; `now_s` is monotonic."""
        for _ in range(REQUESTS_AT_ONCE):
            if not is_waiting(self.socket):
                return
            *frames, body = self.socket.recv_multipart(zmq.NOBLOCK, copy=False)
            route = [frame.bytes for frame in frames]
            answer = self._answer(now_s, route, body, answers, change)
            if answer is not None:
                self._send(route, answer)

    def done(self, number: int, why: str) -> None:
        """The loop's answer to the request of that number; `why` it was not done."""
        if number in self._pending:
            self._send(self._pending.pop(number)[1], packed_error(why) if why else packed_ok())

    def look(self, now_s: float) -> None:
        """Tell those whose requests the loop has not answered."""
        late = [n for n, (since_s, _) in self._pending.items() if now_s > since_s + PENDING_S]
        for number in late:
            self.done(number, "the loop does not answer; the log of the daemon may say why")

    def close(self) -> None:
        self.socket.close()

    def _answer(
        self,
        now_s: float,
        route: list[bytes],
        body: zmq.Frame,
        answers: Mapping[str, Callable[[], Body]],
        change: Change,
    ) -> Body | None:
        """None where the loop is to answer."""
        request = unpack(body.bytes)
        command = request.pop("cmd", None)
        if not isinstance(command, str) or command not in (*answers, *CHANGES):
            known = ", ".join((*answers, *CHANGES))
            return packed_error(f"unknown cmd {command!r:.100}; known: {known}")
        arguments: dict[str, Any] = {}
        if command == PRIOR:
            prior = read_prior(request)
            if isinstance(prior, str):
                return packed_error(f"prior: {prior}")
            arguments = asdict(prior)
        elif request:
            return packed_error(f"unknown key {next(iter(request))!r:.100}; {command} takes none")
        if command in answers:
            return answers[command]()
        refusal = self._may_change(body)
        if refusal:
            return packed_error(f"{command}: {refusal}")
        number = next(NUMBERS)
        if len(self._pending) >= PENDING_MAX or not change(number, command, arguments):
            return packed_error("the loop is busy; ask again")
        self._pending[number] = now_s, route
        return None

    def _send(self, route: list[bytes], answer: Body) -> None:
        """The envelope goes back as it came; a client that fetches no answers loses them."""
        with contextlib.suppress(zmq.ZMQError):
            self.socket.send_multipart([*route, answer], flags=zmq.NOBLOCK)


def open_router(context: zmq.Context[Any]) -> zmq.Socket[Any]:
    return open_socket(context, zmq.ROUTER, send=QUEUED, receive=QUEUED, largest=REQUEST_BYTES)


def packed_ok(**parts: Body) -> Body:
    """An answer of maps that are packed already."""
    packer = msgpack.Packer()
    head: bytes = packer.pack_map_header(1 + len(parts)) + packer.pack("ok") + packer.pack(True)
    return head + b"".join(packer.pack(name) + body for name, body in parts.items())


def packed_error(error: str) -> Body:
    made: bytes = msgpack.packb({"ok": False, "error": error})
    return made


def for_members(group: str) -> MayChange:
    """Who may change something at an ipc endpoint: root, the daemon's own user, and members of the
    group, as the kernel knew them when they connected. The function gives the reason for a refusal
    of the peer that sent a frame, empty where there is none."""
    try:
        number = grp.getgrnam(group).gr_gid if group else -1
    except KeyError:
        number = -1
    refusal = (
        f"is for members of the group {group}: sudo usermod -aG {group} USER, and log in again"
    )
    if number <= 0:  # nobody is to join root's group
        refusal = (
            f"is for the daemon's own user; {group or 'the group'} is no group here, or root's"
        )

    def why_not(frame: zmq.Frame) -> str:
        try:
            with sender(frame) as peer:
                _, user, own_group = credentials(peer)
                found = peer.getsockopt(kernel.SOL_SOCKET, SO_PEERGROUPS, GROUPS_BYTES)
        except OSError:
            return refusal
        groups = {own_group, *struct.unpack(f"{len(found) // 4}I", found)}
        return "" if user in (0, os.geteuid()) or number in groups else refusal

    return why_not
