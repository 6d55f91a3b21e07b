"""Who is let in where keys are taken."""

from typing import Any

import zmq
from zmq.auth import Authenticator

from taxeld.config.tables import CurveConfig
from taxeld.stream.curve import RelayKeys, takes_keys

DOMAIN = "taxeld"
HANDSHAKES_PER_TICK = 4


class Guard(Authenticator):
    """Lets in who holds an authorised key; asked now and then, it never waits (ZAP, RFC 27)."""

    def __init__(
        self, context: zmq.Context[Any], keys: RelayKeys | None, curve: CurveConfig
    ) -> None:
        super().__init__(context)
        self.refused = 0  # connections without an authorised key
        self._keys = keys
        self._curve = curve
        if keys is not None:
            self.configure_curve_callback(DOMAIN, self)

    def callback(self, _: str, key: bytes) -> bool:
        """What Authenticator asks of a credentials provider."""
        known = self._keys is not None and key in self._keys.clients
        self.refused += not known
        return known

    def takes_keys(self, endpoint: str) -> bool:
        return takes_keys(endpoint, self._curve)

    def serve(self, socket: zmq.Socket[Any]) -> None:
        """Only those who hold a client's key may connect to `socket`."""
        assert self._keys is not None  # noqa: S101  (the configuration was refused without)
        if self.zap_socket is None:
            self.start()
        socket.setsockopt(zmq.CURVE_SERVER, 1)
        socket.setsockopt(zmq.CURVE_SECRETKEY, self._keys.secret)
        socket.setsockopt_string(zmq.ZAP_DOMAIN, DOMAIN)

    def poll(self) -> None:
        """Answer the handshakes that are under way, a few at a time."""
        for _ in range(HANDSHAKES_PER_TICK if self.zap_socket else 0):
            try:
                asked = self.zap_socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            try:
                self.handle_zap_message(asked).send(None)  # it awaits nothing: no event loop
            except StopIteration:
                continue
