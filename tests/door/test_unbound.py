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


def taken(sockets: Sockets, endpoint: str) -> zmq.Socket[Any]:
    made = sockets.open(zmq.REP)
    made.bind(endpoint)
    return made


def test_where_a_port_is_taken_the_rest_is_served_and_the_port_once_it_is_free(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    stream, control = (f"tcp://127.0.0.1:{free_port()}" for _ in range(2))
    with Sockets() as sockets:
        thieves = [taken(sockets, endpoint) for endpoint in (stream, control)]
        with Stand(tmp_path, relay_publish=(stream,), relay_control=control) as stand:
            stand.received(stand.subscriber(b"/taxeld/e"))
            assert stand.answer({"cmd": "info"})["info"] == INFO
            stand.until(lambda: stand.link.report.unbound == 2)
            for thief in thieves:
                thief.close()
            stand.until(lambda: stand.link.report.unbound == 0)
            stand.received(stand.subscriber(b"/taxeld/e", endpoint=stream))
            assert stand.answer({"cmd": "info"}, control)["info"] == INFO
            assert stand.keeper.starts == 1
    told = [line for line in caplog.messages if stream in line]
    assert told == [
        f"door: relay.publish: cannot bind {stream} (Address already in use); 'ss -tlnp' tells "
        "which program has the port; it is tried again each second",
        f"door: relay.publish: {stream} is bound",
    ]


def test_where_an_address_is_not_on_this_machine_the_rest_is_served(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    endpoint = f"tcp://{ABSENT}:{free_port()}"
    with Stand(tmp_path, relay_publish=(endpoint, "tcp://nic77:9872")) as stand:
        stand.received(stand.subscriber(b"/taxeld/e"))
        stand.until(lambda: stand.link.report.unbound == 2)
    cure = "'ip address' lists this machine's addresses; it is tried again each second"
    assert [line.partition(" (")[0] for line in caplog.messages] == [
        f"door: relay.publish: cannot bind {each}" for each in (endpoint, "tcp://nic77:9872")
    ]
    assert all(line.endswith(cure) for line in caplog.messages)


def test_check_refuses_a_port_that_is_taken(tmp_path: Path) -> None:
    endpoint = f"tcp://127.0.0.1:{free_port()}"
    path = configuration(tmp_path, source=QUIET, relay={"control": endpoint})
    with Sockets() as sockets:
        taken(sockets, endpoint)
        told = refused("check", path)
    assert told.startswith(f"relay.control: cannot bind {endpoint} (Address already in use); ")
    printed("check", path)


def test_a_daemon_whose_port_is_taken_runs_and_its_health_says_so(tmp_path: Path) -> None:
    endpoint = f"tcp://127.0.0.1:{free_port()}"
    path = configuration(tmp_path, source=QUIET, relay={"publish": [endpoint]})
    environment = {k: v for k, v in os.environ.items() if k != "NOTIFY_SOCKET"}

    def is_told() -> bool:
        assert daemon.poll() is None, daemon.communicate()[1]
        answer = client.ask(f"ipc://{tmp_path}/control", "status") or {}
        return bool(answer.get("health")) and "door.unbound 1: the log" in "".join(lines(answer))

    with Sockets() as sockets:
        taken(sockets, endpoint)
        with taxeld("run", path, stderr=subprocess.PIPE, env=environment) as daemon:
            until(is_told)
            daemon.terminate()
            daemon.communicate()
        assert daemon.returncode == 0
