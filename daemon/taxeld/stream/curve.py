"""CURVE: which endpoints take keys, and the keys themselves.

`curve.directory` holds certificates in the form of `zmq.auth`: `server.key_secret`, the door's own
pair; `clients/*.key`, the public keys of those who may subscribe and ask over TCP;
and `robot.key`, where sensor poses come from beyond this machine. They are read once, at start.
"""

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zmq
from zmq.auth import load_certificate
from zmq.utils import z85

from taxeld.config import endpoints
from taxeld.errors import SetupError

KEY = "curve.directory"
OWN, CLIENTS, ROBOT = "server.key_secret", "clients", "robot.key"


@dataclass(frozen=True, slots=True)
class Keys:
    """The keys of a daemon; Z85."""

    public: bytes
    secret: bytes
    robot: bytes  # the robot's public key; empty: its poses come without keys
    clients: frozenset[bytes]  # public keys of the clients over TCP; empty: those take no keys


def takes_keys(endpoint: str) -> bool:
    """Whether an endpoint takes keys where there are any: those beyond this machine do."""
    return endpoint.startswith(endpoints.TCP) and not endpoints.is_local(endpoint)


def read_keys(directory: str, robot: str, served: Iterable[str]) -> Keys | None:
    """The keys that these endpoints need; None without a directory. It must hold the daemon's own
    pair, whichever endpoints take keys.

    Raises:
        SetupError: a key is missing, damaged or open to others.
    """
    if not directory:
        return None
    place = Path(directory)
    public, secret = secret_key(place / OWN)
    robots = public_key(place / ROBOT) if takes_keys(robot) else b""
    clients = frozenset[bytes]()
    if any(map(takes_keys, served)):
        clients = frozenset(map(public_key, sorted((place / CLIENTS).glob("*.key"))))
        if not clients:
            raise SetupError(
                f"{KEY}: no {CLIENTS}/*.key in {directory}; copy the public keys of those "
                "who may subscribe there"
            )
    return Keys(public, secret, robots, clients)


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
        path.stat()  # `load_certificate` does not say why it cannot read a file
        public, secret = load_certificate(path)
        if any(len(z85.decode(k)) != 32 for k in (public, secret) if k):
            raise ValueError("a key is not 32 bytes in Z85")
    except OSError as error:
        why = f"cannot be read ({error.strerror})"
    except (ValueError, LookupError, struct.error) as error:
        why = f"is no certificate ({error})"
    else:
        return public, secret
    raise SetupError(f"{asked_by}: {path} {why}; see docs/stream.md, 'Keys'")
