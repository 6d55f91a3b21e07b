"""The door as a process: it ends without the loop, is back soon, and may do little."""

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from taxeld.door import limits
from taxeld.door.settings import OOM_SCORE, Settings
from taxeld.errors import SetupError
from taxeld.service import doorkeeper
from taxeld.service.doorkeeper import Doorkeeper
from taxeld.stream import link, pair

from ..rig.clocks import until
from ..rig.processes import python
from .stand import INFO, Stand


def test_a_killed_door_is_back_and_subscribers_come_back_by_themselves(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with Stand(tmp_path) as stand:
        heard = stand.subscriber(b"/taxeld/")
        for number in (signal.SIGKILL, signal.SIGABRT, signal.SIGSEGV):
            before = stand.pid
            os.kill(before, number)
            stand.until(lambda before=before: stand.link.is_ready and stand.pid != before)
            while heard.poll(0):
                heard.recv_multipart()
            stand.received(heard)
        assert stand.keeper.starts == 4
        assert stand.answer({"cmd": "info"})["info"] == INFO
    assert "door: ended by SIGKILL; it is started again" in caplog.messages


def test_a_door_that_hangs_is_ended_and_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(link, "SILENT_S", 2.0)  # a door speaks each second
    with Stand(tmp_path) as stand:
        before = stand.pid
        os.kill(before, signal.SIGSTOP)
        stand.until(lambda: stand.link.is_ready and stand.pid != before)
        stand.received(stand.subscriber(b"/taxeld/e"))
        stand.until(lambda: not Path(f"/proc/{before}").exists())


def test_a_door_that_no_descriptor_is_left_for_is_started_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refused() -> None:
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(doorkeeper, "REFUSED_S", 0.1)
    with Stand(tmp_path) as stand:
        before = stand.pid
        with monkeypatch.context() as scarce:
            scarce.setattr(pair, "open_pair", refused)
            os.kill(before, signal.SIGKILL)
            stand.until(lambda: "(Too many open files)" in caplog.text)
        stand.until(lambda: stand.link.is_ready and stand.pid != before)


def test_a_door_ends_with_its_loop(tmp_path: Path) -> None:
    code = (
        "import sys, time\nfrom pathlib import Path\nsys.path.insert(0, sys.argv[2])\n"
        "from tests.door.stand import Stand\nstand = Stand(Path(sys.argv[1]))\n"
        "print(stand.pid, flush=True)\ntime.sleep(60)"
    )
    root = str(Path(__file__).parents[2])
    with subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path), root], stdout=subprocess.PIPE, text=True
    ) as loop:
        assert loop.stdout is not None
        door = int(loop.stdout.readline())
        loop.kill()
        loop.wait()
        until(lambda: "taxeld.door" not in cmdline(door))


def cmdline(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_text(encoding="utf-8")
    except OSError:
        return ""


def test_signals_of_a_terminal_or_a_service_that_stops_leave_the_door_to_its_loop(
    tmp_path: Path,
) -> None:
    with Stand(tmp_path) as stand:
        before = stand.pid
        os.kill(before, signal.SIGINT)
        os.kill(before, signal.SIGTERM)
        stand.received(stand.subscriber(b"/taxeld/e"))
        assert stand.pid == before
    assert not Path(f"/proc/{before}").exists()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["stream", "control", "keys"])
def test_an_endpoint_that_cannot_be_served_is_one_line(tmp_path: Path, kind: str) -> None:
    (tmp_path / "precious").write_text("x", encoding="ascii")
    taken = {
        "stream": {"publish": (f"ipc://{tmp_path}/precious",)},
        "control": {"control": f"ipc://{tmp_path}/precious"},
        "keys": {"keys": str(tmp_path)},
    }[kind]
    said = {
        "stream": "publish.endpoints: .* is no socket; remove it",
        "control": "control.endpoint: .* is no socket; remove it",
        "keys": "curve.directory: .*server.key_secret is not there",
    }[kind]
    with pytest.raises(SetupError, match=said) as error:
        Stand(tmp_path, **taken)
    assert "\n" not in str(error.value)


FAULTY = """#!{python}
import socket, sys, time
end = socket.socket(fileno=int(sys.argv[4]))
end.send(b"\\x92\\x11\\xa7a fault")  # [FAULT, "a fault"]
end.close()
time.sleep(60)  # to end takes time
"""


def test_a_door_that_states_a_fault_is_started_again_after_the_long_pause(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    faulty = tmp_path / "python"
    faulty.write_text(FAULTY.format(python=sys.executable), encoding="utf-8")
    faulty.chmod(0o755)
    with Stand(tmp_path) as stand:
        pauses: list[float] = []
        wait = stand.keeper._stops.wait

        def paused(seconds: float) -> bool:
            pauses.append(seconds)
            return wait(0.01)

        monkeypatch.setattr(stand.keeper._stops, "wait", paused)
        with monkeypatch.context() as failing:
            failing.setattr(sys, "executable", str(faulty))
            os.kill(stand.pid, signal.SIGKILL)
            stand.until(lambda: len(pauses) > 3)
        assert pauses[1:] == [doorkeeper.REFUSED_S] * len(pauses[1:])
        stand.until(lambda: stand.link.is_ready)
    told = [line for line in caplog.messages if line != "door: a fault"]
    assert told == ["door: ended by SIGKILL; it is started again"]


def test_a_second_daemon_leaves_the_first_ones_sockets_alone(tmp_path: Path) -> None:
    with Stand(tmp_path) as first:
        with pytest.raises(SetupError, match="another daemon serves"):
            Stand(tmp_path)
        first.received(first.subscriber(b"/taxeld/e"))


def test_where_nothing_is_served_there_is_no_door() -> None:
    keeper = Doorkeeper(Settings(publish=(), control="", change_group="", robot="", queue=20))
    assert keeper.starts == 0
    keeper.close()


def limit_of(pid: int, name: str) -> int:
    text = Path(f"/proc/{pid}/limits").read_text(encoding="ascii")
    (line,) = [line for line in text.splitlines() if line.startswith(name)]
    return int(line[len(name) :].split()[0])


def test_the_kernel_limits_the_door_and_ends_it_first(tmp_path: Path) -> None:
    with Stand(tmp_path) as stand:
        place = Path(f"/proc/{stand.pid}")
        assert limit_of(stand.pid, "Max data size") == limits.MEMORY_BYTES
        assert limit_of(stand.pid, "Max processes") == 0
        assert limit_of(stand.pid, "Max core file size") == 0
        assert limit_of(stand.pid, "Max realtime priority") == 0
        assert limit_of(stand.pid, "Max open files") <= limits.DESCRIPTORS
        assert int((place / "oom_score_adj").read_text(encoding="ascii")) == OOM_SCORE
        assert len(list((place / "task").iterdir())) < 8


def test_where_memory_is_short_a_door_that_is_starting_goes_before_the_loop_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    starting = tmp_path / "python"
    starting.write_text("#!/bin/sh\nexec sleep 60\n", encoding="ascii")
    starting.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(starting))
    keeper = Doorkeeper(Settings((f"ipc://{tmp_path}/stream",), "", "", "", 1))
    process = until(lambda: keeper._started)[0].process
    score = Path(f"/proc/{process.pid}/oom_score_adj").read_text(encoding="ascii")
    keeper._stops.set()
    process.kill()
    keeper.close()
    assert int(score) == OOM_SCORE


GREEDY = """
from taxeld.door import limits
limits.limit()
try:
    held = [bytearray(1 << 20) for _ in range(4096)]
except MemoryError:
    print("no more", end="")
"""


def test_a_greedy_door_gets_no_more_memory_than_its_limit() -> None:
    assert python(GREEDY).stdout == "no more"
