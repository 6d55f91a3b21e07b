"""Who is let in where keys are taken: ZeroMQ asks for each connection (ZAP, RFC 27)."""

from typing import Any

import zmq
from zmq.utils import z85

from taxeld.stream.curve import RelayKeys

WHERE = "inproc://zeromq.zap.01"
DOMAIN = "taxeld"
FRAMES = 7  # version, number, domain, address, identity, mechanism, key
AT_ONCE = 256  # handshakes, so that those who flood leave no queue behind
OK, DENIED = (b"200", b"OK"), (b"400", b"no key that is authorised")


class Admission:
    """Lets in who holds the secret of an authorised key."""

    def __init__(self, context: zmq.Context[Any], keys: RelayKeys) -> None:
        self.refused = 0  # connections without an authorised key
        self._keys = keys
        self.socket: zmq.Socket[Any] = context.socket(zmq.ROUTER)
        self.socket.setsockopt(zmq.LINGER, 0)
        self.socket.setsockopt(zmq.RCVHWM, 0)  # ZeroMQ's own thread asks: it must not wait
        self.socket.setsockopt(zmq.SNDHWM, 0)
        self.socket.bind(WHERE)

    def serve(self, socket: zmq.Socket[Any]) -> None:
        """Only those who hold a client's key may connect to `socket`."""
        socket.setsockopt(zmq.CURVE_SERVER, 1)
        socket.setsockopt(zmq.CURVE_SECRETKEY, self._keys.secret)
        socket.setsockopt(zmq.ZAP_DOMAIN, DOMAIN.encode())

    def answer(self) -> None:
        """The handshakes that are under way."""
        for _ in range(AT_ONCE):
            try:
                *route, version, number, _, _, _, _, key = self.socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            known = z85.encode(key) in self._keys.clients
            self.refused += not known
            self.socket.send_multipart(
                [*route, version, number, *(OK if known else DENIED), b"", b""]
            )

    def close(self) -> None:
        self.socket.close()
