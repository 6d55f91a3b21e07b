"""CURVE: which endpoints take keys, the keys themselves, and who is let in.

`curve.directory` holds certificates in the form of `zmq.auth`: `server.key_secret`, the daemon's
own; `clients/*.key`, the public keys of those who may subscribe and command; and `robot.key`, where
sensor poses come from beyond this machine. They are read once, at start.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zmq
from zmq.auth import Authenticator, load_certificate
from zmq.utils import z85

from taxeld import endpoints
from taxeld.config import Config, CurveConfig
from taxeld.errors import SetupError

KEY = "curve.directory"
DOMAIN = "taxeld"
HANDSHAKES_PER_TICK = 4
OWN, CLIENTS, ROBOT = "server.key_secret", "clients", "robot.key"


@dataclass(frozen=True, slots=True)
class Keys:
    """Public and secret keys in Z85."""

    public: bytes
    secret: bytes
    clients: frozenset[bytes]
    robot: bytes | None


def takes_keys(endpoint: str, curve: CurveConfig) -> bool:
    return endpoint.startswith(endpoints.TCP) and (
        curve.loopback or not endpoints.is_local(endpoint)
    )


def load(config: Config) -> Keys | None:
    """The keys a run needs; None where none are configured.

    Raises:
        SetupError: one that is needed is missing, damaged or open to others.
    """
    curve = config.curve
    if not curve.directory:
        return None
    directory = Path(curve.directory)
    public, secret = secret_key(directory / OWN)
    clients = [public_key(path) for path in sorted((directory / CLIENTS).glob("*.key"))]
    served = (*config.publish.endpoints, config.control.endpoint)
    if not clients and any(takes_keys(endpoint, curve) for endpoint in served):
        raise SetupError(
            f"{KEY}: no {CLIENTS}/*.key in {directory}; copy the public keys of those "
            "who may subscribe there"
        )
    asks = takes_keys(config.sensor_pose.endpoint, curve)
    robot = public_key(directory / ROBOT) if asks else None
    return Keys(public, secret, frozenset(clients), robot)


def public_key(path: Path, asked_by: str = KEY) -> bytes:
    """Raises SetupError, in the name of `asked_by`, where `path` is no certificate."""
    return _certificate(path, asked_by)[0]


def secret_key(path: Path, asked_by: str = KEY) -> tuple[bytes, bytes]:
    """Public and secret key; SetupError also where others may read them."""
    public, secret = _certificate(path, asked_by)
    if not secret:
        raise SetupError(f"{asked_by}: {path} holds no secret key; see docs/stream.md, 'Keys'")
    if path.stat().st_mode & 0o007:
        raise SetupError(f"{asked_by}: {path} is open to others; chmod 640 {path}")
    return public, secret


def as_client(socket: zmq.Socket[Any], server: bytes, public: bytes, secret: bytes) -> None:
    """Talk to none but who holds the secret of the public key `server`."""
    socket.setsockopt(zmq.CURVE_SERVERKEY, server)
    socket.setsockopt(zmq.CURVE_PUBLICKEY, public)
    socket.setsockopt(zmq.CURVE_SECRETKEY, secret)


def _certificate(path: Path, asked_by: str) -> tuple[bytes, bytes | None]:
    try:
        public, secret = load_certificate(path)
        if any(len(z85.decode(k)) != 32 for k in (public, secret) if k):
            raise ValueError("a key is not 32 bytes in Z85")
    except (OSError, ValueError, KeyError) as error:
        why = "is not there" if not path.exists() else f"is no certificate ({error})"
        raise SetupError(f"{asked_by}: {path} {why}; see docs/stream.md, 'Keys'") from None
    return public, secret


class Guard(Authenticator):
    """Lets in who holds an authorised key; asked once a tick, it never waits (ZAP, RFC 27)."""

    def __init__(self, context: zmq.Context[Any], keys: Keys | None, curve: CurveConfig) -> None:
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

    def join(self, socket: zmq.Socket[Any]) -> None:
        """Make `socket` a client of the robot."""
        assert self._keys is not None  # noqa: S101
        assert self._keys.robot is not None  # noqa: S101
        as_client(socket, self._keys.robot, self._keys.public, self._keys.secret)

    def poll(self) -> None:
        """Answer the handshakes that are under way, a few a tick."""
        for _ in range(HANDSHAKES_PER_TICK if self.zap_socket else 0):
            try:
                asked = self.zap_socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            try:
                self.handle_zap_message(asked).send(None)  # it awaits nothing: no event loop
            except StopIteration:
                continue
