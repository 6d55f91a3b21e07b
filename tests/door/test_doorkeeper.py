"""The door as a process: it ends without the loop, is back soon, and may do little."""

import json
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import zmq

from taxeld.door.settings import LIMITS, OOM_SCORE, Settings
from taxeld.service import doorkeeper
from taxeld.service.doorkeeper import Doorkeeper
from taxeld.stream import topics

from ..rig.clocks import until
from ..rig.commands import refused, refuses
from ..rig.configurations import configuration
from ..rig.processes import free_port
from ..rig.sockets import Sockets
from .stand import INFO, Stand, pid, seq


def test_a_killed_door_is_back_and_subscribers_come_back_by_themselves(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    tcp = f"tcp://127.0.0.1:{free_port()}"
    with Stand(tmp_path, relay_publish=(tcp,)) as stand:
        heard = [stand.listener(b"/taxeld/", endpoint=at) for at in (stand.stream, tcp)]
        for number, own in ((signal.SIGKILL, 0), (signal.SIGSEGV, 0), (signal.SIGKILL, 1)):
            keeper, link, before = stand.keepers[own], stand.link.doors[own], stand.sent
            other = stand.losses(heard[1 - own])
            os.kill(pid(keeper), number)
            stand.until(lambda link=link: not link.is_ready)
            stand.until(lambda link=link: link.is_ready)
            while seq(stand.received(heard[own])) <= before:
                pass
            assert not other.poll(0)
        assert [keeper.starts for keeper in stand.keepers] == [3, 2]
        assert stand.answer({"cmd": "info"})["info"] == INFO
    assert "door: ended: Killed; it is started again" in caplog.messages


def test_signals_of_a_terminal_or_a_service_that_stops_leave_the_door_to_its_loop(
    tmp_path: Path,
) -> None:
    with Stand(tmp_path) as stand:
        before = stand.pid
        os.kill(before, signal.SIGINT)
        os.kill(before, signal.SIGTERM)
        stand.received(stand.listener(b"/taxeld/e"))
        assert stand.pid == before
    assert not Path(f"/proc/{before}").exists()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"publish": ("ipc://{}/precious",)}, "publish.endpoints: .* is no socket; remove it"),
        ({"control": "ipc://{}/precious"}, "control.endpoint: .* is no socket; remove it"),
        ({"control": "ipc://{}/x/y"}, "control.endpoint: .* does not exist; the service makes it"),
        ({"keys": "{}"}, "curve.directory: .*server.key_secret cannot be read"),
        ({"keys": "{}" + "x" * 300}, r"curve.directory: .*cannot be read \(File name too long"),
    ],
)
def test_an_endpoint_that_cannot_be_served_is_one_line(
    tmp_path: Path, settings: dict[str, Any], said: str
) -> None:
    (tmp_path / "precious").write_text("x", encoding="ascii")
    given = json.loads(json.dumps(settings).replace("{}", str(tmp_path)))
    refuses(f"^{said}", Stand, tmp_path, **given)
    assert (tmp_path / "precious").read_text(encoding="ascii") == "x"


FAULTY = """#!{python}
import os, socket, sys
end = socket.socket(fileno=int(sys.argv[4]))
end.send(b"\\x92\\x11\\xa7a fault")  # [FAULT, "a fault"]
os._exit(2)
"""


def test_a_door_that_states_a_fault_is_started_again_after_the_long_pause(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with Stand(tmp_path) as stand:
        keeper = stand.keeper
        with monkeypatch.context() as failing:
            failing.setattr(sys, "executable", executable(tmp_path, FAULTY))
            failing.setattr(doorkeeper, "REFUSED_PAUSE_S", 1000.0)
            os.kill(stand.pid, signal.SIGKILL)
            stand.until(lambda: keeper.starts == 2 and not (keeper._new or keeper._process))
            began_s = time.monotonic()
            assert began_s + 500.0 < keeper._next_s < began_s + 1000.0
        keeper.look(began_s + 1000.0)
        stand.until(lambda: stand.link.is_ready)
    told = [line for line in caplog.messages if line != "door: a fault"]
    assert told == ["door: ended: Killed; it is started again"]


def executable(place: Path, code: str) -> str:
    """A program in place of Python's."""
    path = place / "python"
    path.write_text(code.format(python=sys.executable), encoding="utf-8")
    path.chmod(0o755)
    return str(path)


def test_a_second_daemon_leaves_the_first_ones_sockets_alone(tmp_path: Path) -> None:
    with Stand(tmp_path) as first:
        refuses("another daemon serves", Stand, tmp_path)
        first.received(first.listener(b"/taxeld/e"))


NAMES = ["Max data size", "Max open files", "Max locked memory", "Max file size"]
NAMES += ["Max core file size", "Max realtime priority"]


def test_each_limit_of_the_door_is_set_in_the_kernel_which_ends_it_first(tmp_path: Path) -> None:
    with Stand(tmp_path) as stand:
        place = Path(f"/proc/{stand.pid}")
        text = (place / "limits").read_text(encoding="ascii")
        found = {line[:26].strip(): line[26:].split()[:2] for line in text.splitlines()}
        for name, most in zip(NAMES, LIMITS.values(), strict=True):
            soft, hard = found[name]
            assert soft == hard
            assert int(soft) <= most if name == "Max open files" else int(soft) == most
        assert found["Max processes"] == ["0", "0"]
        assert int((place / "oom_score_adj").read_text(encoding="ascii")) == OOM_SCORE
        assert len(list((place / "task").iterdir())) < 8
        assert stand.relay.starts == 0  # nobody is served over TCP


def test_a_door_ends_when_the_loop_has_let_it_go_or_is_gone_and_is_not_started_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with Stand(tmp_path) as stand:
        detach, process = stand.link.detach, stand.keeper._process

        def until_it_has_ended() -> None:
            detach()
            until(lambda: process.poll() is not None)

        monkeypatch.setattr(stand.link, "detach", until_it_has_ended)
    assert (stand.keeper.starts, caplog.messages) == (1, [])


def test_a_door_that_does_not_start_is_ended_with_its_loop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "executable", executable(tmp_path, "#!/bin/sh\nexec sleep 600\n"))
    monkeypatch.setattr(doorkeeper, "STOP_S", 1.0)
    keeper = Doorkeeper(Settings(publish=(f"ipc://{tmp_path}/stream",)))
    process, _ = until(lambda: keeper._new)
    keeper.close()
    assert (process.poll(), keeper.starts) == (-signal.SIGKILL, 1)


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
