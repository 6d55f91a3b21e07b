"""Descriptors: a daemon that is allowed too few says so at once, and takes all that it may."""

import resource
import subprocess
import sys
import time
from pathlib import Path

import msgpack
import pytest
import zmq

from taxeld.service import descriptors
from taxeld.stream import client, messages

from . import recorded
from .conftest import Sockets
from .crowd import crowd
from .test_cli import configuration

DEADLINE_S = 60.0


def limiting(soft: int, hard: int, *command: str) -> list[str]:
    set_limit = f"import resource, os, sys\nresource.setrlimit(7, ({soft}, {hard}))\n"
    run = "os.execv(sys.executable, [sys.executable, *sys.argv[1:]])"
    assert resource.RLIMIT_NOFILE == 7
    return [sys.executable, "-c", set_limit + run, *command]


def limited(soft: int, hard: int, *command: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        limiting(soft, hard, *command),
        capture_output=True, text=True, check=False, timeout=DEADLINE_S,
    )  # fmt: skip


@pytest.mark.parametrize("allowed", [16, 20, descriptors.NEEDED - 1])
def test_a_daemon_that_may_open_too_little_is_one_line_and_status_2(
    tmp_path: Path, allowed: int
) -> None:
    path = configuration(tmp_path)
    done = limited(allowed, allowed, "-m", "taxeld.cli", "run", str(path))
    assert done.returncode == 2
    assert done.stderr == (
        f"{allowed} open files are allowed, and the daemon needs {descriptors.NEEDED}: "
        "raise the limit (LimitNOFILE= of the unit, or ulimit -n)\n"
    )


def test_a_limit_that_may_be_raised_is_raised() -> None:
    code = (
        "import resource; from taxeld.service import descriptors; descriptors.ensure(); "
        "print(resource.getrlimit(resource.RLIMIT_NOFILE))"
    )
    done = limited(20, 4096, "-c", code)
    assert done.stdout == "(4096, 4096)\n", done.stderr


def test_a_daemon_outlives_who_takes_all_its_descriptors_and_loses_no_subscriber(
    tmp_path: Path, sockets: Sockets
) -> None:
    recorded.write_session(tmp_path, touches=60)
    config = recorded.configuration(tmp_path)
    stream, control = tmp_path / "stream", tmp_path / "control"

    def subscriber() -> "zmq.Socket[bytes]":
        socket = sockets.open(zmq.SUB)
        socket.setsockopt(zmq.RCVHWM, 0)
        socket.setsockopt(zmq.SUBSCRIBE, messages.ESTIMATE)
        socket.connect(f"ipc://{stream}")
        return socket

    honest = subscriber()
    seqs: list[int] = []

    def hear(count: int) -> None:
        for _ in range(count):
            assert honest.poll(1000 * DEADLINE_S), "nothing is published any more"
            seqs.append(msgpack.unpackb(honest.recv_multipart()[1])["seq"])

    command = limiting(256, 256, "-m", "taxeld.cli", "run", str(config))
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as daemon:
        hear(10)
        with crowd(stream, 200), crowd(stream, 200), crowd(control, 200):
            hear(50)
            newcomer = subscriber()
            assert newcomer.poll(1000 * DEADLINE_S), "one more process is served"
        hear(50)
        again = subscriber()
        assert again.poll(1000 * DEADLINE_S), "and so are all, once the others have gone"
        deadline = time.monotonic() + DEADLINE_S
        while client.ask(f"ipc://{control}", "status") is None:
            assert time.monotonic() < deadline
        assert daemon.poll() is None
        daemon.terminate()
        said = daemon.communicate(timeout=DEADLINE_S)[1]
    assert daemon.returncode == 0
    assert seqs == list(range(seqs[0], seqs[0] + len(seqs))), "the first has missed nothing"
    assert said.count("newcomers are turned away") in (1, 2), said  # once an endpoint
