"""The door as a process: it ends without the loop, is back soon, and may do little."""

import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

import pytest

from taxeld.door.settings import LIMITS, OOM_SCORE, Settings
from taxeld.errors import SetupError
from taxeld.service import doorkeeper
from taxeld.service.doorkeeper import Doorkeeper

from ..rig.clocks import until
from ..rig.processes import free_port
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
    with pytest.raises(SetupError, match=f"^{said}") as error:
        Stand(tmp_path, **given)
    assert "\n" not in str(error.value)
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
        pauses: list[float] = []
        wait = stand.keeper._stops.wait

        def paused(seconds: float) -> bool:
            pauses.append(seconds)
            return wait(0.01)

        monkeypatch.setattr(stand.keeper._stops, "wait", paused)
        with monkeypatch.context() as failing:
            failing.setattr(sys, "executable", executable(tmp_path, FAULTY))
            os.kill(stand.pid, signal.SIGKILL)
            stand.until(lambda: len(pauses) > 3)
        assert pauses[1:] == [doorkeeper.REFUSED_PAUSE_S] * len(pauses[1:])
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
        with pytest.raises(SetupError, match="another daemon serves"):
            Stand(tmp_path)
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
        assert process is not None

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
    process = until(lambda: keeper._newest)
    keeper.close()
    assert (process.poll(), keeper.starts) == (-signal.SIGKILL, 1)
