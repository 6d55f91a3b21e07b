"""Rerun's viewer as a process beside, which nothing but this machine can reach.

The library's own `spawn` and `serve` listen on every interface, so the program is started here.
"""

import os
import signal
import socket
import subprocess
import sys
import time
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import Self

from taxeld.errors import SetupError

HOST = "127.0.0.1"
PORT, WEB_PORT = 9876, 9090  # Rerun's own, where they are free
START_S = 60.0  # a slow machine reads 280 MB first
MEMORY = "2GB"  # of the viewer; it drops the oldest beyond


@dataclass
class Viewer:
    """A running viewer; `web` ends with us, a window stays."""

    address: str  # for what is logged
    page: str  # for a browser, or empty
    process: subprocess.Popen[bytes]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self.page or error is not None:
            self.process.terminate()
            self.process.wait()

    @property
    def is_gone(self) -> bool:
        """Whether it was closed."""
        return self.process.poll() is not None


def start(*, web: bool) -> Viewer:
    """Start it and wait until it listens.

    Raises:
        SetupError: there is no screen or no such program, or it ended at once.
    """
    program = _program()
    if not web and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise SetupError("view: no screen here; use --save FILE, or --web for a browser")
    port, web_port = _free(PORT), _free(WEB_PORT)
    address, page = f"rerun+http://{HOST}:{port}/proxy", ""
    command = [program, "--bind", HOST, "--port", str(port), "--memory-limit", MEMORY]
    command += ["--hide-welcome-screen", "--expect-data-soon"]
    if web:
        command += ["--serve-web", "--web-viewer-port", str(web_port)]
        page = f"http://{HOST}:{web_port}?url={address}"
    process = subprocess.Popen(  # noqa: S603  (our own environment's program)
        command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        start_new_session=True,  # Ctrl-C here is not for it
    )  # fmt: skip
    for one in (port, web_port) if web else (port,):
        _await(process, one)
    return Viewer(address, page, process)


def _program() -> str:
    """The viewer itself: what stands in PATH starts it and does not end it."""
    package = find_spec("rerun_cli")
    places = package.submodule_search_locations if package is not None else None
    found = [path for place in places or () for path in Path(place).glob("rerun*") if _is_run(path)]
    if not found:
        raise SetupError(
            "view: the program 'rerun' is not there: "
            f"{sys.executable} -m pip install --force-reinstall rerun-sdk"
        )
    return str(found[0])


def _is_run(path: Path) -> bool:
    return path.is_file() and os.access(path, os.X_OK)


def _free(port: int) -> int:
    """The port, or another where it is taken."""
    for wanted in (port, 0):
        with socket.socket() as probe:
            try:
                probe.bind((HOST, wanted))
            except OSError:
                continue
            return int(probe.getsockname()[1])
    raise SetupError(f"view: no free port at {HOST}")


def _await(process: subprocess.Popen[bytes], port: int) -> None:
    end_s = time.monotonic() + START_S
    while time.monotonic() < end_s:
        if process.poll() is not None:
            code = process.returncode
            how = signal.Signals(-code).name if code < 0 else f"status {code}"
            raise SetupError(f"view: the viewer ended at once ({how}); use --save FILE or --web")
        with socket.socket() as probe:
            probe.settimeout(1.0)
            if probe.connect_ex((HOST, port)) == 0:
                return
        time.sleep(0.05)
    process.kill()
    process.wait()
    raise SetupError(f"view: the viewer does not answer after {START_S:.0f} s; use --save FILE")
