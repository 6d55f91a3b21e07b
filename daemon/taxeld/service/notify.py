"""Messages to systemd: ready, alive, a line of status, stopping (sd_notify(3)).

They are datagrams to $NOTIFY_SOCKET that nothing waits for. Without a service manager none is sent.
"""

import contextlib
import os
import socket
from collections.abc import Callable, Mapping

STATUS_S = 1.0
WATCHDOG_SHARE = 0.5  # share of the manager's time-out: the longest time between two signs of life


class Notifier:
    """Sends the messages; only the main loop calls it, so that a hanging loop sends nothing."""

    def __init__(self, environ: Mapping[str, str] = os.environ) -> None:
        self._address = environ.get("NOTIFY_SOCKET", "")
        if self._address.startswith("@"):  # the abstract name space
            self._address = "\0" + self._address[1:]
        usec, pid = environ.get("WATCHDOG_USEC", ""), environ.get("WATCHDOG_PID", "")
        is_watched = usec.isdecimal() and pid in ("", str(os.getpid()))
        self.watchdog_s = 1e-6 * int(usec) if is_watched else 0.0  # the manager's time-out
        self._socket: socket.socket | None = None
        if self._address:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._socket.setblocking(False)
        self._next_status_s = self._next_watchdog_s = float("-inf")

    def ready(self) -> None:
        """The start is complete, and the loop is about to tick."""
        self._send("READY=1")

    def tick(self, now_s: float, status: Callable[[float], str]) -> None:
        """The loop has made a pass; `status(now_s)` is one short line, asked for once a second."""
        if self._socket is None:
            return
        if self.watchdog_s and now_s >= self._next_watchdog_s and self._send("WATCHDOG=1"):
            self._next_watchdog_s = now_s + WATCHDOG_SHARE * self.watchdog_s
        if now_s >= self._next_status_s:
            self._next_status_s = now_s + STATUS_S
            self._send(f"STATUS={status(now_s)}")

    def stopping(self) -> None:
        self._send("STOPPING=1")
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, message: str) -> bool:
        """Send a message; → whether it was sent. If the manager is busy, the next tick tries
        again."""
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.sendto(message.encode(), self._address)
                return True
        return False
