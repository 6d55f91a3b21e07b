"""Rerun's viewer as a process beside this one, which nothing but this machine can reach.

The library's own `spawn` and `serve_grpc` listen on every interface and take no other address, so
the program is started here.
"""

import os
import signal
import socket
import subprocess
import sys
import time

from taxeld.errors import SetupError

HOST = "127.0.0.1"
PORT, WEB_PORT = 9876, 9090  # Rerun's own, where they are free
START_S = 60.0  # a slow machine reads 280 MB first
MEMORY = "2GB"  # of the viewer, which drops the oldest data beyond it


class Viewer:
    """A viewer that listens at `address`, as a window or with a `page` for a browser."""

    def __init__(self, *, web: bool) -> None:
        """Start it and wait until it listens.

        Raises:
            SetupError: there is no screen, or the program ended at once.
        """
        if not web and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            raise SetupError("view: no screen here; use --save FILE, or --web for a browser")
        self.ports = [_free(PORT), _free(WEB_PORT)][: 1 + web]
        self.address = f"rerun+http://{HOST}:{self.ports[0]}/proxy"
        self.page = f"http://{HOST}:{self.ports[-1]}?url={self.address}" if web else ""
        command = [sys.executable, "-m", "rerun_cli", "--bind", HOST, "--port", f"{self.ports[0]}"]
        command += ["--memory-limit", MEMORY, "--hide-welcome-screen", "--expect-data-soon"]
        command += ["--serve-web", "--web-viewer-port", f"{self.ports[-1]}"] * web
        quiet = subprocess.DEVNULL
        self._process = subprocess.Popen(  # noqa: S603  (our own environment's program)
            command,
            stdin=quiet,
            stdout=quiet,
            stderr=quiet,
            start_new_session=True,  # Ctrl-C here is not for it
        )
        end_s = time.monotonic() + START_S
        while not all(map(_listens, self.ports)):
            if self.is_gone or time.monotonic() > end_s:
                how = "ended at once" if self.is_gone else f"does not answer after {START_S:.0f} s"
                self.close()
                raise SetupError(f"view: the viewer {how}; use --save FILE, or --web for a browser")
            time.sleep(0.05)

    @property
    def is_gone(self) -> bool:
        """Whether it was closed."""
        return self._process.poll() is not None

    def close(self) -> None:
        """End the program, which is a child of the Python that starts it."""
        if not self.is_gone:
            os.killpg(self._process.pid, signal.SIGTERM)
            self._process.wait()


def _free(port: int) -> int:
    """The port, or another where it is taken."""
    with socket.socket() as probe:
        try:
            probe.bind((HOST, port))
        except OSError:
            return _free(0)
        return int(probe.getsockname()[1])


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex((HOST, port)) == 0
