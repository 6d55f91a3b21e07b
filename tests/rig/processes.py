"""The commands as processes of their own, and what such processes are asked."""

import contextlib
import os
import socket
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

ATTACKS = Path(__file__).parents[1] / "vm" / "attacks.py"
TAXELD = [sys.executable, "-m", "taxeld.cli"]
PIPES: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}


def taxeld(*arguments: object, **how: Any) -> "subprocess.Popen[str]":
    """A command that has been started; `how`: of Popen."""
    return subprocess.Popen([*TAXELD, *map(str, arguments)], text=True, **how)


def replayed(session: Path, *options: object, env: Mapping[str, str] | None = None) -> bytes:
    """What `taxeld replay` prints of a session; `env`: more of the environment."""
    command = [*TAXELD, "replay", str(session), *map(str, options)]
    environment = os.environ | (env or {})
    return subprocess.run(command, capture_output=True, check=True, env=environment).stdout


def python(
    code: str, *arguments: object, check: bool = True, env: Mapping[str, str] | None = None
) -> "subprocess.CompletedProcess[str]":
    """A program of a few lines, run to its end."""
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=check, env=env)


@contextlib.contextmanager
def attacked(attack: str, endpoint: str, *more: str) -> Iterator[None]:
    """Meanwhile an attacker is at work (tests/vm/attacks.py)."""
    command = [sys.executable, str(ATTACKS), attack, endpoint, "3600", *more]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        try:
            yield
        finally:
            process.kill()


def free_port() -> int:
    """Of TCP on this machine, a moment ago."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return probe.getsockname()[1]  # type: ignore[no-any-return]


def resident_bytes(pid: int) -> int:
    pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")
