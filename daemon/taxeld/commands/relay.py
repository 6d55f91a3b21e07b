"""`taxeld relay`: a daemon's streams over TCP, from its ipc.

A process of its own, so that whatever a peer does to ZeroMQ ends this one and not the loop. It only
listens to the daemon: subscribers, keys and questions are dealt with here, and `status` and `info`
are answered from what has been heard. Only `tare` and `reset` are passed on, where `relay.change`
says so.
"""

import contextlib
import logging
import math
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import msgpack
import zmq

from taxeld.config.tables import Config
from taxeld.errors import SetupError
from taxeld.service.notify import Notifier
from taxeld.stream import client, curve, messages
from taxeld.stream.answers import Handler
from taxeld.stream.control import POLL_S, Control
from taxeld.stream.guard import Guard
from taxeld.stream.hoard import Hoard
from taxeld.stream.publisher import Publisher
from taxeld.stream.sockets import connect, open_socket, unpack

ALWAYS = (messages.ESTIMATE, messages.HEALTH, messages.INFO)  # the rest once somebody asks for it
SUBSCRIPTIONS = 64  # that may wait for the daemon: beyond it ZeroMQ drops them
MESSAGES_PER_STEP = 256
MESSAGE_BYTES = 1 << 24
SILENT_S = 2.0  # without an estimate for so long, the daemon is not there
REFUSED_S = 10.0  # between lines about connections that were refused
CHANGE_S = 0.2  # until the daemon has answered; the streams wait
CHANGES = ("tare", "reset")
log = logging.getLogger(__name__)


class Relay:
    """A configuration, being relayed."""

    def __init__(self, config: Config) -> None:
        """Open everything a relay needs; the daemon need not be there.

        Raises:
            SetupError: something of it cannot be used.
        """
        self.stopping = False
        self._config = config
        self._heard_s = -math.inf
        self._latest: dict[bytes, bytes] = {}
        self._subscribed = set(ALWAYS)
        self._refused, self._next_refused_s = 0, -math.inf
        if not config.publish.endpoints or not config.relay.publish:
            empty = "relay.publish" if config.publish.endpoints else "publish.endpoints"
            raise SetupError(f"{empty}: is empty, so there is nothing to relay")
        if config.relay.change and not config.control.endpoint:
            raise SetupError("relay.change: needs control.endpoint, which is empty")
        with contextlib.ExitStack() as opened:
            context: zmq.Context[Any] = opened.enter_context(zmq.Context())
            self._guard = Guard(context, curve.relay_keys(config), config.curve)
            opened.callback(self._guard.stop)
            queue = round(config.loop.rate_hz)  # about a second
            self._daemon = opened.enter_context(
                open_socket(
                    context, zmq.SUB, send=SUBSCRIPTIONS, receive=4 * queue, largest=MESSAGE_BYTES
                )
            )
            for topic in ALWAYS:
                self._daemon.setsockopt(zmq.SUBSCRIBE, topic)
            connect(self._daemon, config.publish.endpoints[0], "publish.endpoints")
            self._publisher = Publisher(
                context, queue, guard=self._guard, frames=config.relay.frames
            )
            opened.callback(self._publisher.close)
            self._publisher.bind(config.relay.publish, "relay.publish")
            self._hoard = Hoard(filter(None, (*config.relay.publish, config.relay.control)))
            opened.callback(self._hoard.close)
            self._control: Control | None = None
            if config.relay.control:
                self._control = Control(
                    context, config.relay.control, "relay.control", self._handlers(), self._guard
                )
                opened.callback(self._control.close)
            self._opened = opened.pop_all()

    def stop(self) -> None:
        """End `run` after this step."""
        self.stopping = True

    def run(self, between: Callable[[], None] = lambda: None) -> None:
        """Relay until `stop`; `between` is called between two steps."""
        notifier = Notifier()
        try:
            notifier.ready()
            while not self.stopping:
                self.step()
                between()
                notifier.tick(time.monotonic(), self._status_line)
        finally:
            notifier.stopping()
            self.close()

    def step(self) -> None:
        """Wait a moment for the daemon, and deal with all who have come."""
        self._daemon.poll(round(1e3 * POLL_S))
        for _ in range(MESSAGES_PER_STEP):
            try:
                frames = self._daemon.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                break
            self._pass_on(frames)
        now_s = time.monotonic()
        self._publisher.greet(now_s, time.time())
        for topic in self._publisher.wanted - self._subscribed:
            self._subscribed.add(topic)
            self._daemon.setsockopt(zmq.SUBSCRIBE, topic)
        self._hoard.look(now_s)
        self._guard.poll()
        if self._control is not None:
            self._control.poll(now_s)
        if self._guard.refused > self._refused and now_s >= self._next_refused_s:
            self._next_refused_s = now_s + REFUSED_S
            log.warning("%d connections without an authorised key", self._guard.refused)
            self._refused = self._guard.refused

    def close(self) -> None:
        self._opened.close()

    def _pass_on(self, frames: list[bytes]) -> None:
        topic, body, stamp = frames  # the daemon's own
        if topic == messages.HEALTH:
            body = self._with_own_counts(body)
        if topic in ALWAYS:
            self._latest[topic] = body
        if topic == messages.ESTIMATE:
            self._heard_s = time.monotonic()
        self._publisher.forward((topic, body, stamp))

    def _with_own_counts(self, body: bytes) -> bytes:
        """Health, with what only this process knows of those whom it turns away."""
        health = unpack(body)
        health["keys_refused"] = self._guard.refused
        health["hoarders"] = health.get("hoarders", 0) + self._hoard.hung_up
        packed: bytes = msgpack.packb(health)
        return packed

    def _is_silent(self) -> bool:
        return time.monotonic() - self._heard_s > SILENT_S

    def _status_line(self, _: float) -> str:
        daemon = "the daemon is silent" if self._is_silent() else "relaying"
        counted = self._publisher.counters
        return f"{daemon}, {counted.joined} subscriptions, {self._guard.refused} peers refused"

    def _handlers(self) -> dict[str, Handler]:
        handlers: dict[str, Handler] = {"status": self._on_status, "info": self._on_info}
        if self._config.relay.change:
            for command in CHANGES:
                handlers[command] = partial(self._change, command)
        return handlers

    def _on_status(self) -> dict[str, Any]:
        if self._is_silent():
            return _error("the daemon is silent; is 'taxeld run' there?")
        return {
            "estimate": unpack(self._latest[messages.ESTIMATE]),
            "health": unpack(self._latest.get(messages.HEALTH, b"")),
        }

    def _on_info(self) -> dict[str, Any]:
        if messages.INFO not in self._latest:
            return _error("the daemon has not been heard yet; is 'taxeld run' there?")
        return {"info": unpack(self._latest[messages.INFO])}

    def _change(self, command: str) -> dict[str, Any]:
        answer = client.ask(self._config.control.endpoint, command, timeout_s=CHANGE_S)
        return answer or _error("the daemon does not answer; is 'taxeld run' there?")


def _error(text: str) -> dict[str, Any]:
    return {"ok": False, "error": text}
