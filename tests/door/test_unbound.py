"""A TCP address that cannot be bound now: the door serves the rest, says so, and tries again."""

import os
import subprocess
from pathlib import Path
from typing import Any

import pytest
import zmq

from taxeld.commands.status import lines
from taxeld.stream import client

from ..rig.clocks import until
from ..rig.commands import printed, refused
from ..rig.configurations import QUIET, configuration
from ..rig.processes import free_port, taxeld
from ..rig.sockets import Sockets
from .stand import INFO, Stand

ABSENT = "192.0.2.1"  # of documents (RFC 5737): no machine has it
AGAIN = "it is tried again each second"
HERE = "'ip address' lists this machine's addresses"


def taken(sockets: Sockets, endpoint: str) -> zmq.Socket[Any]:
    made = sockets.open(zmq.REP)
    made.bind(endpoint)
    return made


def test_where_an_address_cannot_be_had_the_rest_is_served_and_the_address_once_it_can(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    stream, control = (f"tcp://127.0.0.1:{free_port()}" for _ in range(2))
    absent = f"tcp://{ABSENT}:{free_port()}", "tcp://nic77:9872"
    with Sockets() as sockets:
        thieves = [taken(sockets, endpoint) for endpoint in (stream, control)]
        with Stand(tmp_path, relay_publish=(stream, *absent), relay_control=control) as stand:
            stand.received(stand.subscriber(b"/taxeld/e"))
            assert stand.answer({"cmd": "info"})["info"] == INFO
            stand.until(lambda: stand.link.report.unbound == 4)
            for thief in thieves:
                thief.close()
            stand.until(lambda: stand.link.report.unbound == 2)
            stand.received(stand.subscriber(b"/taxeld/e", endpoint=stream))
            assert stand.answer({"cmd": "info"}, control)["info"] == INFO
            assert stand.keeper.starts == 1
    assert [line for line in caplog.messages if stream in line] == [
        f"door: relay.publish: cannot bind {stream} (Address already in use); 'ss -tlnp' tells "
        f"which program has the port; {AGAIN}",
        f"door: relay.publish: {stream} is bound",
    ]
    for endpoint in absent:
        (line,) = (line for line in caplog.messages if endpoint in line)
        assert line.startswith(f"door: relay.publish: cannot bind {endpoint} (")
        assert line.endswith(f"; {HERE}; {AGAIN}")


def test_check_refuses_a_port_that_is_taken_and_a_daemon_runs_whose_health_says_so(
    tmp_path: Path,
) -> None:
    endpoint = f"tcp://127.0.0.1:{free_port()}"
    path = configuration(tmp_path, source=QUIET, relay={"publish": [endpoint]})
    environment = {k: v for k, v in os.environ.items() if k != "NOTIFY_SOCKET"}

    def is_told() -> bool:
        assert daemon.poll() is None, daemon.communicate()[1]
        answer = client.ask(f"ipc://{tmp_path}/control", "status") or {}
        return bool(answer.get("health")) and "door.unbound 1: the log" in "".join(lines(answer))

    with Sockets() as sockets:
        taken(sockets, endpoint)
        told = refused("check", path)
        assert told.startswith(f"relay.publish: cannot bind {endpoint} (Address already in use); ")
        with taxeld("run", path, stderr=subprocess.PIPE, env=environment) as daemon:
            until(is_told)
            daemon.terminate()
            daemon.communicate()
        assert daemon.returncode == 0
    printed("check", path)
