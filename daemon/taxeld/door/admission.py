"""Who is let in where keys are taken; pyzmq answers ZeroMQ's questions in a thread of its own."""

from typing import Any

import zmq
from zmq.auth.thread import ThreadAuthenticator

from taxeld.stream.curve import Keys

DOMAIN = "taxeld"


class Admission:
    """Lets in who holds the secret of an authorised key."""

    def __init__(self, context: zmq.Context[Any], keys: Keys) -> None:
        self.refused = 0  # connections without an authorised key
        self._keys = keys
        self._authenticator = ThreadAuthenticator(context)
        self._authenticator.configure_curve_callback(DOMAIN, self)
        self._authenticator.start()

    def callback(self, _: str, key: bytes) -> bool:
        """Whether the holder of a public key may connect; called by the authenticator's thread."""
        is_known = key in self._keys.clients
        self.refused += not is_known
        return is_known

    def guard(self, socket: zmq.Socket[Any]) -> None:
        """Only those who hold a client's key may connect to `socket`."""
        socket.setsockopt(zmq.CURVE_SERVER, 1)
        socket.setsockopt(zmq.CURVE_SECRETKEY, self._keys.secret)
        socket.setsockopt(zmq.ZAP_DOMAIN, DOMAIN.encode())

    def close(self) -> None:
        self._authenticator.stop()
