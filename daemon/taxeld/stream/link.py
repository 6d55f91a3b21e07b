"""The loop's end of the pair: messages go out, and all that comes is checked as if the door were
hostile."""

import contextlib
import logging
import math
import socket
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from itertools import chain
from typing import Any

import msgpack

from taxeld.prior import PosePrior
from taxeld.stream import pair
from taxeld.stream.pair import Kind
from taxeld.stream.topics import INFO, TOPICS
from taxeld_protocol.array import ID_MAX, ArrayFrame

PACKETS_PER_LOOK = 64
PACKETS_HZ = 20_000.0  # with more packets and poses a second the door is not one of ours
BODY_MAX = 16_384  # bytes of a packet from the door: an array of 5000 values has 10 000
CHANGES_HZ = 20.0  # tare, reset and priors that are done, at most
COUNT_MAX = 2**53
TEXT_MAX = 500  # characters of a line
REASON_MAX = 120  # characters of why a message is no pose
TOPICS_MAX, TOPIC_MAX = 4, 60  # other topics of the robot, and characters of each
HEARD_S = 1.5  # the same, before what it last reported is no longer taken for the present
SILENT_S = 5.0  # without a packet for so long, the door hangs
START_S = 30.0  # the same while a door starts: a busy machine takes seconds for it
LOOK_MOST_S = 0.5  # silence counted for one look: the loop itself may have been stopped
REFUSED = (  # a packet that raises one of these is none
    *(ValueError, LookupError, TypeError, AttributeError),
    *(msgpack.UnpackException, struct.error),
)
SEVERITIES = (logging.INFO, logging.WARNING, logging.ERROR)
log = logging.getLogger(__name__)

OnPose = Callable[[float, float, float, float], None]
OnArray = Callable[[ArrayFrame], None]
Handler = Callable[[], str | None]  # → why it was not done
OnPrior = Callable[[PosePrior], str]
"""→ why it is not taken, empty where it is."""


@dataclass(slots=True)
class PeerLine:
    """A connection to who sends poses, or arrays."""

    connected: bool = False
    refused: bool = False  # the handshake fails
    malformed: int = 0  # messages of the topic that are no pose, or no array
    reason: str = ""  # why the last of them is none
    topics: list[str] = field(default_factory=list)  # others that are heard while no pose comes


@dataclass(slots=True)
class Report:
    """The door's account of itself, once a second; counts since its start."""

    robot: PeerLine = field(default_factory=PeerLine)
    array: PeerLine = field(default_factory=PeerLine)
    confined: bool = False  # by Landlock
    keys_refused: int = 0  # connections without an authorised key
    unbound: int = 0  # TCP endpoints that are tried again


class Link:
    """Messages to whoever is the door now; poses, changes and reports from it."""

    def __init__(
        self, info: Mapping[str, Any], on_pose: OnPose, handlers: Mapping[str, Handler]
    ) -> None:
        """`info`: the map of `/taxeld/info`; `on_pose` is given each pose (t, x, y, θ) that is
        finite; `handlers` do what clients may change, by command."""
        self.unsent = 0  # messages that the door did not take in time, since the loop's start
        self.report = Report()
        self.is_ready = False
        self.fault = ""  # why the door has ended, if it said so
        self._pack: Callable[[object], bytes] = msgpack.Packer().pack
        self._info = self._pack(info)
        self._on_pose = on_pose
        self.on_poses: dict[int, OnPose] = {}  # of further links, by their numbers
        self.on_array: OnArray = lambda _: None  # is given each array whose time is finite
        self.on_prior: OnPrior = lambda *_: "no prior is taken here"
        self._handlers = handlers
        self._socket: socket.socket | None = None
        self._wanted = 0
        self._silent_s = self._looked_s = 0.0
        self._allowed = PACKETS_HZ
        self._changes = CHANGES_HZ

    @property
    def end(self) -> socket.socket | None:
        """The loop's end of the pair, readable when the door has spoken; each door has its own."""
        return self._socket

    @property
    def is_heard(self) -> bool:
        """Whether the door speaks: it reports once a second."""
        return self._silent_s < HEARD_S

    def attach(self, end: socket.socket, now_s: float) -> None:
        """A new door; `now_s` is monotonic."""
        self.detach()
        self._socket, self.fault = end, ""
        self._looked_s, self._silent_s = now_s, 0.0
        self._allowed, self._changes = PACKETS_HZ, CHANGES_HZ
        self.report = Report()
        self._send(INFO, self._info, 0.0)

    def detach(self) -> None:
        """The door is gone, or is to go."""
        if self._socket is not None:
            self._socket.close()
        self._socket, self.is_ready, self._wanted = None, False, 0
        self.report.robot.connected = self.report.array.connected = False

    def wants(self, topic: bytes) -> bool:
        """Whether somebody has subscribed to the topic."""
        return bool(self._wanted >> TOPICS.index(topic) & 1)

    def send(self, topic: bytes, message: Mapping[str, Any], t: float) -> None:
        """A message of Unix time t; lost, and counted, where a door that is ready does not take it
        now."""
        if self.is_ready:
            self._send(topic, self._pack(message), t)

    def tell(self, state: Mapping[str, Any]) -> None:
        """The part of the answer to `status` that no message has."""
        if self.is_ready:
            self._give(Kind.STATE, self._pack(state))

    def remember(self, scans: bytes) -> None:
        """The scans that the belief has learned from, for clients that learn them as well."""
        if self.is_ready:
            self._give(Kind.MEMORY, scans)

    def ask_poses(self, *, also_next: bool) -> None:
        """Have the door pass on the robot's poses that have come, and, if `also_next`, the next
        one when it comes. Without being asked it passes them on every tenth of a second."""
        if self.is_ready:
            self._give(Kind.ASK, bytes((also_next,)))

    def look(self, now_s: float) -> None:
        """Take what the door has said, up to a bound; without a word for too long it is let go."""
        if self._socket is None:
            return
        passed_s = now_s - self._looked_s
        self._looked_s = now_s
        self._silent_s += min(passed_s, LOOK_MOST_S)
        self._allowed = min(self._allowed + PACKETS_HZ * passed_s, PACKETS_HZ)
        self._changes = min(self._changes + CHANGES_HZ * passed_s, CHANGES_HZ)
        for _ in range(PACKETS_PER_LOOK):
            try:
                packet = self._socket.recv(BODY_MAX + 1)
            except BlockingIOError:
                break
            except ConnectionResetError:  # the kernel says so ahead of what the door has sent
                continue
            except OSError:
                packet = b""
            if not packet:
                self.detach()
                return
            self._silent_s = 0.0
            self._allowed -= 1.0
            if len(packet) <= BODY_MAX:
                with contextlib.suppress(*REFUSED):
                    self._take(packet[0], packet[1:])
            if self._socket is None:
                return
        most_s = SILENT_S if self.is_ready else START_S
        if self._allowed < 0.0 or self._silent_s > most_s:
            log.warning("door: %s", "hangs" if self._allowed >= 0.0 else "sends without end")
            self.detach()

    def _take_poses(self, on_pose: OnPose, body: bytes) -> None:
        poses = list(pair.POSE.iter_unpack(body))
        if all(map(math.isfinite, chain(*poses))):
            self._allowed -= len(poses)
            for pose in poses:
                on_pose(*pose)

    def _take(self, kind: int, body: bytes) -> None:
        """Raises one of REFUSED where the packet is none that is known."""
        match kind:
            case Kind.POSES:
                self._take_poses(self._on_pose, body)
            case Kind.POSES_OF:
                self._take_poses(self.on_poses[body[0]], body[1:])
            case Kind.ARRAY:
                frame = pair.unpack_array(body)
                is_name = frame.id.isprintable() and len(frame.id) <= ID_MAX
                if math.isfinite(frame.t) and frame.counts and is_name:
                    self.on_array(frame)
            case Kind.WANTED:
                (self._wanted,) = body
            case Kind.CHANGE:
                (number,) = pair.REQUEST.unpack_from(body)
                self._change(number, self._handlers[body[pair.REQUEST.size :].decode()])
            case Kind.PRIOR:
                number, pose = pair.unpack_prior(body)
                self._change(number, lambda: self.on_prior(pose))
            case Kind.REPORT:
                self.report = read_report(msgpack.unpackb(body))
            case Kind.LOG:
                log.log(SEVERITIES[body[0]], "door: %s", line_of(body[1:]))
            case Kind.READY if not body:
                self.is_ready = True
            case Kind.FAULT:
                self.fault = line_of(body)

    def _change(self, number: int, handler: Handler) -> None:
        """Answer request `number`."""
        why = ""
        if self._changes < 1.0:
            why = f"more than {CHANGES_HZ:.0f} a second are not done; ask again"
        else:
            self._changes -= 1.0
            why = handler() or ""
        self._give(Kind.ANSWER, pair.REQUEST.pack(number) + why.encode())

    def _send(self, topic: bytes, body: bytes, t: float) -> None:
        self._give(Kind.MESSAGE, pair.HEAD.pack(TOPICS.index(topic), t) + body)

    def _give(self, kind: Kind, body: bytes) -> None:
        if self._socket is None:
            return
        send = pair.send if len(body) < pair.PACKET_MAX else pair.send_large
        try:
            self.unsent += not send(self._socket, kind, body)
        except OSError:  # the door is gone, which the next look finds
            self.unsent += 1


def read_report(given: object) -> Report:
    """A report whose values have the types and bounds that they must have.

    Raises:
        TypeError, ValueError, LookupError: it is none.
    """
    made = Report()
    _fill(made, given)
    return made


def line_of(body: bytes) -> str:
    """One printable line of at most TEXT_MAX characters, whatever was sent."""
    text = body.decode("utf-8", "backslashreplace")[:TEXT_MAX]
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def _fill(into: Any, given: Any) -> None:
    """Fill the dataclass `into` from the map `given`, which must have the same keys."""
    if set(given) != {f.name for f in fields(into)}:
        raise ValueError("other keys")
    for f in fields(into):
        before, value = getattr(into, f.name), given[f.name]
        if isinstance(before, int):  # a bool as well
            if type(value) is not type(before) or not 0 <= value <= COUNT_MAX:
                raise ValueError(f.name)
        elif isinstance(before, str):
            value = line_of(value.encode())[:REASON_MAX]
        elif isinstance(before, list):
            value = [line_of(name.encode())[:TOPIC_MAX] for name in value[:TOPICS_MAX]]
        else:
            _fill(before, value)
            continue
        setattr(into, f.name, value)
