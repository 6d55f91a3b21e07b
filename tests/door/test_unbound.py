"""An endpoint that cannot be reached now: the door serves the rest, says so, and tries again."""

from pathlib import Path
from typing import Any

import pytest
import zmq

from taxeld.stream import topics

from ..rig.commands import refused
from ..rig.configurations import configuration
from ..rig.processes import free_port
from ..rig.sockets import Sockets
from .stand import INFO, Stand, seq

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
        told = refused("check", configuration(tmp_path, relay={"publish": [stream]}))
        assert told.startswith(f"relay.publish: cannot bind {stream} (Address already in use); ")
        with Stand(tmp_path, relay_publish=(stream, *absent), relay_control=control) as stand:
            stand.received(stand.listener(b"/taxeld/e"))
            assert stand.answer({"cmd": "info"})["info"] == INFO
            stand.until(lambda: stand.link.counts["unbound"] == 4)
            for thief in thieves:
                thief.close()
            stand.until(lambda: stand.link.counts["unbound"] == 2)
            stand.received(stand.listener(b"/taxeld/e", endpoint=stream))
            assert stand.answer({"cmd": "info"}, control)["info"] == INFO
            assert [keeper.starts for keeper in stand.keepers] == [1, 1]
    assert [line for line in caplog.messages if stream in line] == [
        f"door: relay.publish: cannot bind {stream} (Address already in use); 'ss -tlnp' tells "
        f"which program has the port; {AGAIN}",
        f"door: relay.publish: {stream} is bound",
    ]
    for endpoint in absent:
        (line,) = (line for line in caplog.messages if endpoint in line)
        assert line.startswith(f"door: relay.publish: cannot bind {endpoint} (")
        assert line.endswith(f"; {HERE}; {AGAIN}")


def test_a_socket_file_that_was_removed_is_made_anew_and_the_file_of_another_is_left(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with Sockets() as sockets:
        with Stand(tmp_path) as stand:
            heard = stand.listener(topics.ESTIMATE)
            before, lost = seq(stand.received(heard)), stand.losses(heard)
            for path in tuple(tmp_path.iterdir()):
                path.unlink()
            stand.received(stand.listener(topics.ESTIMATE))
            assert stand.answer({"cmd": "info"})["info"] == INFO
            assert seq(stand.received(heard)) == before + 1
            assert not lost.poll(0)
            taken(sockets, stand.stream)
            stand.until(lambda: stand.link.counts["unbound"])
        assert [path.name for path in tmp_path.iterdir()] == ["stream"]
    said = f"door: publish.endpoints: {stand.stream} was removed; {AGAIN}"
    assert caplog.messages.count(said) == 2
