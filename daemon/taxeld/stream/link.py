"""The loop's end of a pair: messages go out, and what the door says is done.

The door is ours, so its packets are trusted for their form. How many are taken at once is bounded,
as peers have a part in them; those that the pair has no room for are lost in the door.
"""

import logging
import socket
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import msgpack

from taxeld.stream import pair
from taxeld.stream.pair import Kind
from taxeld.stream.topics import INFO
from taxeld_protocol.array import ArrayFrame

PACKETS_PER_LOOK = 64
HEARD_S = 1.5  # without a packet for so long, what the door last reported is of the past
SILENT_S = 5.0  # without a packet for so long, the door hangs
START_S = 30.0  # the same while a door starts: a busy machine takes seconds for it
LOOK_MOST_S = 0.5  # silence counted for one look: the loop itself may have been stopped
log = logging.getLogger(__name__)

OnPose = Callable[[float, float, float, float, float, int], None]
OnArray = Callable[[ArrayFrame], None]
Handler = Callable[..., str | None]  # → why it was not done


@dataclass(slots=True)
class PeerLine:
    """A connection to who sends poses, or arrays."""

    connected: bool = False
    refused: bool = False  # the handshake fails
    malformed: int = 0  # messages of the topic that are no pose, or no array
    reason: str = ""  # why the last of them is none


@dataclass(slots=True)
class Report:
    """The door's account of itself, once a second; counts since its start."""

    robot: PeerLine = field(default_factory=PeerLine)
    array: PeerLine = field(default_factory=PeerLine)
    keys_refused: int = 0  # connections without an authorised key
    unbound: int = 0  # TCP endpoints that are tried again


class Link:
    """Messages to whoever is the door now; poses, changes and reports from it."""

    def __init__(
        self,
        info: Mapping[str, Any],
        on_pose: OnPose,
        handlers: Mapping[str, Handler],
        relay: "Link | None" = None,
    ) -> None:
        """`info`: the map of `/taxeld/info`; `on_pose` is given each pose (t, x, y, θ), the Unix
        time at which it came and the number of its link; `handlers` do what clients may change, by
        command; `relay`: to the door of peers over TCP, which gets all that this one gets."""
        self.doors = (self,) if relay is None else (self, relay)
        self.unsent = 0  # messages that the door did not take in time, since the loop's start
        self.failed = 0  # packets and changes that raised an exception, since the loop's start
        self.report = Report()
        self.is_ready = False
        self.is_asking = False  # whether the door has not answered the last question for poses
        self.fault = ""  # why the door has ended, if it said so
        self.on_array: OnArray = lambda _: None
        # the loop's end of the pair, readable when the door has spoken; each door has its own
        self.end: socket.socket | None = None
        self._pack: Callable[[object], bytes] = msgpack.Packer().pack
        self._info = self._pack(info)
        self._on_pose = on_pose
        self._handlers = handlers
        self._wanted = frozenset[bytes]()
        self._silent_s = self._looked_s = 0.0

    @property
    def is_heard(self) -> bool:
        """Whether the door speaks: it reports once a second."""
        return self._silent_s < HEARD_S

    @property
    def ready(self) -> list[socket.socket | None]:
        """Of each door that is ready, the loop's end."""
        return [each.end for each in self.doors if each.is_ready]

    @property
    def counts(self) -> dict[str, int]:
        """What is counted of all doors."""
        return {
            "unsent": sum(each.unsent for each in self.doors),
            "failed": sum(each.failed for each in self.doors),
            "keys_refused": sum(each.report.keys_refused for each in self.doors),
            "unbound": sum(each.report.unbound for each in self.doors),
        }

    def attach(self, end: socket.socket, now_s: float) -> None:
        """A new door; `now_s` is monotonic."""
        self.detach()
        self.end, self.fault, self.report = end, "", Report()
        self._looked_s, self._silent_s = now_s, 0.0
        self._give(Kind.MESSAGE, INFO, 0.0, self._info)

    def detach(self) -> None:
        """The door is gone, or is to go."""
        if self.end is not None:
            self.end.close()
        self.end, self.is_ready, self._wanted = None, False, frozenset()
        self.is_asking = False
        self.report.robot.connected = self.report.array.connected = False

    def wants(self, topic: bytes) -> bool:
        """Whether somebody has subscribed to the topic."""
        return any(topic in each._wanted for each in self.doors)

    def send(self, topic: bytes, message: Mapping[str, Any], t: float) -> None:
        """A message of Unix time t; lost, and counted, where a door that is ready does not take it
        now."""
        self._tell(Kind.MESSAGE, topic, t, self._pack(message))

    def tell(self, state: Mapping[str, Any]) -> None:
        """The part of the answer to `status` that no message has."""
        self._tell(Kind.STATE, state)

    def remember(self, scans: int) -> None:
        """The scans that the belief has learned from, an open file of numpy's, for clients that
        learn them as well."""
        self._tell(Kind.MEMORY, file=scans)

    def ask_poses(self, *, also_next: bool) -> None:
        """Have the door pass on the robot's poses that have come, and, if `also_next`, the next
        one when it comes. Without being asked it passes them on every tenth of a second."""
        if self.is_ready:
            self.is_asking = True
            self._give(Kind.ASK, also_next)

    def look(self, now_s: float) -> None:
        """Take what the door has said, up to a bound; without a word for too long it is let go."""
        self._silent_s += min(now_s - self._looked_s, LOOK_MOST_S)
        self._looked_s = now_s
        for _ in range(PACKETS_PER_LOOK):
            if self.end is None or not self._take_next(self.end):
                break
        if self.end is not None and self._silent_s > (SILENT_S if self.is_ready else START_S):
            log.warning("door: hangs")
            self.detach()

    def _take_next(self, end: socket.socket) -> bool:
        """Whether there was a packet. A door whose packet cannot be taken is let go."""
        try:
            packet = pair.receive(end)
            if packet is not None:
                self._silent_s = 0.0
                self._take(*packet)
            return packet is not None
        except ConnectionResetError:  # the kernel says so ahead of what the door has sent
            return True
        except (EOFError, OSError):
            self.detach()
        except Exception as error:  # a fault of ours ends neither the loop nor its recording
            self._say("a packet of the door", error)
            self.detach()
        return False

    def _take(self, kind: int, values: list[Any]) -> None:
        match kind, values:
            case Kind.POSES, [each, is_answer, came]:
                self.is_asking &= not is_answer
                for link, poses in enumerate(each):
                    for t, x, y, theta in poses:
                        self._on_pose(t, x, y, theta, came, link)
            case Kind.ARRAY, [t, name, rest, counts]:
                self.on_array(ArrayFrame(t, name, rest, tuple(counts)))
            case Kind.WANTED, [topics]:
                self._wanted = frozenset(topics)
            case Kind.CHANGE, [number, command, arguments]:
                self._give(Kind.ANSWER, number, self._done(command, arguments))
            case Kind.REPORT, [report]:
                robot, array = (PeerLine(**report.pop(name)) for name in ("robot", "array"))
                self.report = Report(robot, array, **report)
            case Kind.LOG, [level, line]:
                log.log(level, "door: %s", line)
            case Kind.READY, []:
                self.is_ready = True
            case Kind.FAULT, [line]:
                self.fault = line
            case _:
                raise ValueError(f"kind {kind} with {len(values)} values")

    def _done(self, command: str, arguments: Mapping[str, Any]) -> str:
        """Do what a client asks; → why it was not done, empty where it was."""
        try:
            return self._handlers[command](**arguments) or ""
        except Exception as error:
            self._say(command, error)
            return "it failed; the log of the daemon says where"

    def _say(self, what: str, error: Exception) -> None:
        """Log and count an exception, in one line."""
        self.failed += 1
        at = traceback.extract_tb(error.__traceback__)[-1]
        kind = type(error).__name__
        log.error("%s: failed at %s:%s (%s: %s)", what, at.filename, at.lineno, kind, error)

    def _tell(self, kind: Kind, *values: object, file: int | None = None) -> None:
        """To each door that is ready."""
        for each in self.doors:
            if each.is_ready:
                each._give(kind, *values, file=file)

    def _give(self, kind: Kind, *values: object, file: int | None = None) -> None:
        if self.end is None:
            return
        try:
            self.unsent += not pair.send(self.end, kind, *values, file=file)
        except OSError:  # the door is gone, which the next look finds
            self.unsent += 1
