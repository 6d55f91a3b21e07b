"""DDS as ROS 2 uses it: topics by their ROS names, with the qualities of service of its nodes."""

import logging
import math
import os
import time
from collections.abc import Callable
from typing import Any

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.core import DDSException, Listener, Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from taxeld.errors import SetupError

DOMAIN = "ROS_DOMAIN_ID"
DOMAIN_MAX = 232  # beyond it there are no ports
BLOCKED_MS = 1  # that a reliable reader which does not keep up may hold a writer
TAKEN = 200  # messages at once
AGAIN_S = 30.0  # between lines of one kind
# what writers of ROS 2 offer, and what a reader of either kind takes
CDR = Policy.DataRepresentation(use_cdrv0_representation=True)
RELIABLE = Policy.Reliability.Reliable(duration(milliseconds=BLOCKED_MS))
BEST_EFFORT = Policy.Reliability.BestEffort
LATCHED = Policy.Durability.TransientLocal

log = logging.getLogger(f"taxeld.{__name__}")  # which the command has written


class Output:
    """A topic that is written to. A reader that does not keep up loses messages, alone."""

    def __init__(self, name: str, writer: Any) -> None:
        self.lost = 0
        self._name, self._writer = name, writer
        self._next_line_s = -math.inf

    def write(self, message: Any) -> None:
        """Never raises for what a reader does, and waits for none longer than `BLOCKED_MS`."""
        try:
            self._writer.write(message)
        except DDSException as error:
            self.lost += 1
            now_s = time.monotonic()
            if now_s >= self._next_line_s:
                self._next_line_s = now_s + AGAIN_S
                log.warning(
                    "/%s: %d messages were lost (%s); a reader does not keep up",
                    self._name, self.lost, error.msg.strip(),
                )  # fmt: skip


def last(depth: int, *policies: Any) -> Qos:
    """The last `depth` messages are kept."""
    return Qos(CDR, Policy.History.KeepLast(depth), *policies)


class Participant:
    """One of a ROS domain; `None` is that of ROS_DOMAIN_ID, or 0."""

    def __init__(self, domain: int | None = None) -> None:
        """Raises SetupError: the domain is none, or DDS cannot be had."""
        self.domain = domain_of(domain)
        try:
            self._participant = DomainParticipant(self.domain)
        except DDSException as error:
            raise SetupError(
                f"DDS cannot be had in domain {self.domain} ({error.msg.strip()}); look at "
                "CYCLONEDDS_URI and the network"
            ) from None
        self._seen = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)

    def writer(self, name: str, kind: type, qos: Qos) -> Output:
        """Of the ROS topic `/name`."""
        made = DataWriter(self._participant, self._topic(name, kind), qos=qos)
        return Output(name.strip("/"), made)

    def reader(self, name: str, kind: type, qos: Qos, on_data: Callable[[], None]) -> Any:
        """`on_data` is called by a thread of DDS when something has come."""
        listener = Listener(on_data_available=lambda _: on_data())
        return DataReader(self._participant, self._topic(name, kind), qos=qos, listener=listener)

    def kinds_of(self, name: str) -> set[str]:
        """The ROS types under which others publish a topic."""
        wanted = _dds_name(name)
        found = (seen for seen in self._seen.read(N=1000) if seen.topic_name == wanted)
        return {_ros_type(seen.type_name) for seen in found}

    def _topic(self, name: str, kind: type) -> Any:
        return Topic(self._participant, _dds_name(name), kind)


def taken(reader: Any) -> list[Any]:
    """The messages that have come, without what DDS tells of writers that have gone."""
    return [sample for sample in reader.take(N=TAKEN) if sample.sample_info.valid_data]


def domain_of(given: int | None) -> int:
    """Raises SetupError where it is none."""
    text = os.environ.get(DOMAIN, "0") if given is None else str(given)
    if not text.isascii() or not text.isdigit() or int(text) > DOMAIN_MAX:
        told = DOMAIN if given is None else "--domain"
        raise SetupError(f"{told}: must be 0..{DOMAIN_MAX}, not {text!r}")
    return int(text)


def ros_type(kind: Any) -> str:
    """`geometry_msgs/msg/Pose` of a class of `ros_types`."""
    return _ros_type(str(kind.__idl_typename__).replace(".", "::"))


def _ros_type(name: str) -> str:
    return name.replace("::dds_::", "::").removesuffix("_").replace("::", "/")


def _dds_name(name: str) -> str:
    return "rt/" + name.strip("/")
