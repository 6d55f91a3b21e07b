"""The harness as a subscriber: the daemon's messages, judged and printed as they come."""

import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import msgpack
import numpy as np
import zmq

from taxeld.estimator.estimate import Status
from taxeld.pipeline.freshness import Why
from taxeld.stream import topics
from taxeld_hil.grade.judge import Judge, Sample
from taxeld_hil.run.contact_table import ContactTable

Say = Callable[[str], None]


class Listener:
    """One subscription; `judge` and `table` may be replaced at any time."""

    def __init__(
        self,
        stack: ExitStack,
        context: "zmq.Context[Any]",
        endpoint: str,
        judge: Judge,
        table: ContactTable,
        say: Say,
    ) -> None:
        """`say` prints a line for each contact."""
        self.judge = judge
        self.table = table
        self.begun = False  # whether an estimate of a scan has come
        self._finished_wall = np.inf
        self._say = say
        self._stream = socket(stack, context, zmq.SUB)
        self._stream.connect(endpoint)
        for topic in (topics.ESTIMATE, topics.TAXELS, topics.HEALTH):
            self._stream.setsockopt(zmq.SUBSCRIBE, topic)

    def wait(self, ms: int) -> None:
        """Wait for a message, so many milliseconds at most."""
        self._stream.poll(ms)

    def receive(self, t: float) -> None:
        """Take what has come by scenario time t."""
        while self._stream.poll(0):
            topic, body, _ = self._stream.recv_multipart()
            message = msgpack.unpackb(body)
            if topic == topics.TAXELS:
                self.table.on_taxels(message)
            elif topic == topics.HEALTH:
                self.judge.on_health(t, message)
            elif time.time() < self._finished_wall:
                self.begun |= message["t"] > 0.0
                line = self.table.on_estimate(message)
                if line:
                    self._say(line)
                self.judge.on_estimate(sample(message, t))

    def drop(self) -> None:
        """Discard what has come."""
        while self._stream.poll(0):
            self._stream.recv_multipart()

    def finish(self) -> None:
        """All has been sent: what is estimated from now on does not count."""
        self._finished_wall = time.time()


def sample(message: dict[str, Any], t: float) -> Sample:
    """An estimate's message, received at scenario time t."""
    pose = message["map"]
    return Sample(
        t,
        Status(message["status"]),
        Why(message["why"]),
        message["contacts"],
        np.array([pose["x"], pose["y"], pose["theta"]]),
        message["p"],
        message["radius_m"],
        message["t"],
        1e-6 * message["age_us"],
        message["lat_us"]["total"],
        message["object"],
    )


def socket(stack: ExitStack, context: "zmq.Context[Any]", kind: int) -> "zmq.Socket[Any]":
    """One that is closed with the stack, and keeps nothing back."""
    opened: zmq.Socket[Any] = stack.enter_context(context.socket(kind))
    opened.setsockopt(zmq.LINGER, 0)
    return opened
