"""DDS as ROS 2 uses it: topics by their ROS names, with the qualities of service of its nodes."""

import functools
import logging
import math
import os
import time
from collections.abc import Callable
from typing import Any

from cyclonedds.core import DDSException, Listener, Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import make_idl_struct, types
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from taxeld.errors import SetupError
from taxeld.view import ros

DOMAIN = "ROS_DOMAIN_ID"
DOMAIN_MAX = 232  # higher domains have no ports
BLOCKED_MS = 1  # a reliable reader that does not keep up holds a writer no longer
TAKEN = 200  # messages taken at once
AGAIN_S = 30.0  # shortest period of log lines of one kind
# ROS 2 writes and reads this representation
CDR = Policy.DataRepresentation(use_cdrv0_representation=True)
RELIABLE = Policy.Reliability.Reliable(duration(milliseconds=BLOCKED_MS))
BEST_EFFORT = Policy.Reliability.BestEffort
LATCHED = Policy.Durability.TransientLocal
EMPTY = {"string": "", "bool": False}  # values of fields that are left out; others are 0

log = logging.getLogger(f"taxeld.{__name__}")  # the command writes the logs of taxeld


@functools.cache
def kind_of(name: str) -> Any:
    """The class by which Cyclone DDS writes and reads a ROS type, as `geometry_msgs/Pose`."""
    package, _, short = name.partition("/")
    fields = {field: _idl(kind) for kind, field in ros.fields(name)}
    return make_idl_struct(short, f"{package}::msg::dds_::{short}_", fields)


def message(name: str, values: dict[str, Any]) -> Any:
    """A ROS message of a map of its fields; fields that are left out are zero or empty."""
    fields = ros.fields(name)
    return kind_of(name)(*(_value(kind, values.get(field)) for kind, field in fields))


class Output:
    """A topic that is written to. A reader that does not keep up loses messages, alone."""

    def __init__(self, name: str, kind: str, writer: Any) -> None:
        self.lost = 0
        self._name, self._kind, self._writer = name, kind, writer
        self._next_line_s = -math.inf

    def write(self, values: dict[str, Any]) -> None:
        """Send a message. Readers never make it fail, nor wait longer than `BLOCKED_MS`."""
        try:
            self._writer.write(message(self._kind, values))
        except DDSException as error:
            self.lost += 1
            now_s = time.monotonic()
            if now_s >= self._next_line_s:
                self._next_line_s = now_s + AGAIN_S
                text = "/%s: %d messages were lost (%s); a reader does not keep up"
                log.warning(text, self._name, self.lost, error.msg.strip())


class Participant:
    """A participant of the ROS domain that ROS_DOMAIN_ID names, or of 0."""

    def __init__(self) -> None:
        """Raises SetupError: the domain is none, or DDS cannot be had."""
        self.domain = _domain()
        try:
            self._participant = DomainParticipant(self.domain)
        except DDSException as error:
            raise SetupError(
                f"DDS cannot be had in domain {self.domain} ({error.msg.strip()}); look at "
                "CYCLONEDDS_URI and the network"
            ) from None

    def writer(self, name: str, kind: str, depth: int, *policies: Any) -> Output:
        """Of the ROS topic `/name`; the last `depth` messages are kept for a reader."""
        qos = Qos(CDR, Policy.History.KeepLast(depth), RELIABLE, *policies)
        made = DataWriter(self._participant, self._topic(name, kind), qos=qos)
        return Output(name.strip("/"), kind, made)

    def reader(self, name: str, kind: str, on_data: Callable[[], None], *policies: Any) -> Any:
        """`on_data` is called by a thread of DDS when a message has come."""
        listener = Listener(on_data_available=lambda _: on_data())
        qos = Qos(CDR, Policy.History.KeepLast(100), *policies)
        return DataReader(self._participant, self._topic(name, kind), qos=qos, listener=listener)

    def _topic(self, name: str, kind: str) -> Any:
        return Topic(self._participant, _dds_name(name), kind_of(kind))


def taken(reader: Any) -> list[Any]:
    """The messages that have come, without what DDS tells of writers that have gone."""
    return [sample for sample in reader.take(N=TAKEN) if sample.sample_info.valid_data]


def _idl(kind: str) -> Any:
    """A field's type for Cyclone DDS: of `float64`, `geometry_msgs/Pose[]`, `float64[36]`."""
    base, is_many, length = kind.rstrip("]").partition("[")
    plain = {"string": str, "bool": bool}.get(base)
    one = plain or (kind_of(base) if "/" in base else getattr(types, base))
    if not is_many:
        return one
    return types.array[one, int(length)] if length else types.sequence[one]


def _value(kind: str, given: Any) -> Any:
    """A field of this type; the empty one for None."""
    base, is_many, _ = kind.partition("[")
    if is_many:
        return [_value(base, one) for one in given] if given and "/" in base else given or []
    if "/" in base:
        return message(base, given or {})
    return EMPTY.get(base, 0) if given is None else given


def _domain() -> int:
    """The number of the domain. Raises SetupError for one that DDS does not have."""
    text = os.environ.get(DOMAIN, "0")
    if not text.isascii() or not text.isdigit() or int(text) > DOMAIN_MAX:
        raise SetupError(f"{DOMAIN}: must be 0..{DOMAIN_MAX}, not {text!r}")
    return int(text)


def _dds_name(name: str) -> str:
    return "rt/" + name.strip("/")
