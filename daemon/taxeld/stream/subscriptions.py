"""What subscribers ask for, and what carries it to them."""

from collections.abc import Iterable, Set
from dataclasses import dataclass
from typing import Protocol

from taxeld.stream import messages
from taxeld.stream.server import PeerCounters

BEGIN, END = b"\x01", b"\x00"  # what stands before a prefix of topics
PREFIX_MAX = 1024  # bytes
EVENTS_MAX = 256  # of a peer in COUNTED_S; of more it is hung up on
COUNTED_S = 10.0

Frames = tuple[bytes, ...]  # topic, map, and, but for some relays, time


@dataclass(slots=True)
class SubscriberCounters(PeerCounters):
    """Since start."""

    joined: int = 0  # subscriptions to topics of ours
    left: int = 0  # ends of such
    foreign: int = 0  # subscriptions to none of our topics
    malformed: int = 0  # messages that are neither
    hung_up: int = 0  # peers that sent too many of any


class Outlet(Protocol):
    """Endpoints of a kind, and those who have subscribed there."""

    @property
    def wanted(self) -> Set[bytes]:
        """Topics that somebody there has asked for."""

    def listen(self, now_s: float, info: Frames | None) -> None:
        """Take subscriptions, and give newcomers who ask for it `info`, where it is known."""

    def forward(self, frames: Frames) -> None:
        """Send a message to whom it may concern."""

    def close(self) -> None: ...


def topics_of(prefixes: Iterable[bytes]) -> frozenset[bytes]:
    """Our topics among those that begin so."""
    begins = tuple(prefixes)
    return frozenset(topic for topic in messages.TOPICS if topic.startswith(begins))
