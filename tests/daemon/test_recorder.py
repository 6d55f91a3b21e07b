"""What a recording leaves behind, however it ends: killed, with a full disk, or before it began."""

import errno
import os
import re
import resource
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from taxeld.cli import main
from taxeld.errors import SetupError
from taxeld.source import recorder as recorders
from taxeld.source import session
from taxeld.source.recorder import Recorder
from taxeld_protocol import slcan
from taxeld_protocol.frames import Chunk, Frame
from tests.rig.clocks import PATIENCE_S, until
from tests.rig.commands import printed, refused
from tests.rig.configurations import configuration
from tests.rig.disks import disk
from tests.rig.processes import PIPES, taxeld
from tests.rig.sessions import items_of
from tests.rig.skins import CHANNELS, MODULES
from tests.rig.virtual_hub import VirtualHub

SMALL_DISK = 30_000  # bytes a file may have, in place of a disk that is nearly full
ON_A_SMALL_DISK: dict[str, Any] = {
    "preexec_fn": lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (SMALL_DISK, SMALL_DISK))
}


@pytest.fixture(params=[False, True], ids=["slcan", "native"])
def hub(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[VirtualHub]:
    with VirtualHub(tmp_path / "skin", MODULES, native=request.param) as made:
        yield made


def configured(place: Path, hub: VirtualHub) -> Path:
    return configuration(
        place, source=hub.source | {"period_ms": 10}, filter={"proposal": "manifold"}
    )


def serve(hub: VirtualHub, done: Callable[[], bool]) -> None:
    until(done, lambda: hub.serve(time.monotonic(), lambda k: [k + 1] * CHANNELS))


def recorded_bytes(out: Path) -> int:
    """As they went over the wire; those of the host's few requests as well."""
    if not (out / session.ARRIVALS).exists() or (out / session.ARRIVALS).stat().st_size < 200:
        return 0
    items = items_of(out)
    return sum(len(each.data if isinstance(each, Chunk) else slcan.encode(each)) for each in items)  # type: ignore[arg-type]


@pytest.mark.check
@pytest.mark.parametrize("is_full", [False, True])
def test_a_recorder_that_is_killed_or_has_a_full_disk_leaves_what_it_heard_but_for_the_last_moment(
    tmp_path: Path, hub: VirtualHub, is_full: bool
) -> None:
    out, disk = tmp_path / "session", ON_A_SMALL_DISK if is_full else {}
    process = taxeld("record", "--out", out, configured(tmp_path, hub), **PIPES, **disk)
    try:
        serve(hub, lambda: process.poll() is not None if is_full else hub.scans >= 22)
        sent = hub.written
        serve(hub, lambda: is_full or recorded_bytes(out) >= sent)  # written while more comes
    finally:
        process.kill()
        _, errors = process.communicate(timeout=PATIENCE_S)
    ended = f"{out}: the recording has ended ({os.strerror(errno.EFBIG)})\n"
    assert (process.returncode, errors) == ((1, ended) if is_full else (-signal.SIGKILL, ""))
    replayed = taxeld("replay", out, **PIPES)
    printed, errors = replayed.communicate(timeout=PATIENCE_S)
    assert replayed.returncode == 0
    assert len(printed.splitlines()) >= 11
    assert re.fullmatch(rf"({out}: the recording was cut; [^\n]*\n)?", errors)


def test_a_device_that_cannot_be_opened_leaves_no_directory_behind(tmp_path: Path) -> None:
    hub = VirtualHub(tmp_path / "skin", MODULES, native=True)
    config = configured(tmp_path, hub)
    hub.unplug()
    out = tmp_path / "a" / "session"
    for _ in range(2):
        assert "source.channel: cannot open" in refused("record", "--out", out, config)
        assert sorted(tmp_path.iterdir()) == [config]


def test_a_recording_of_nothing_leaves_what_was_there_before(tmp_path: Path) -> None:
    place, config = tmp_path / "s", tmp_path / "config.toml"
    config.write_text("[source]\n", encoding="utf-8")
    place.mkdir()
    (place / "notes").touch()
    with Recorder(place, moves=True, config=config):
        pass
    assert [path.name for path in place.iterdir()] == ["notes"]


BY_HAND = b"by hand\n"
RECORD, RUN = ("record", "--out"), ("run", "--record")


@pytest.mark.parametrize(
    ("command", "name", "make"),
    [
        (RECORD, session.CONFIG, lambda path, _: path.write_bytes(BY_HAND)),
        (RECORD, session.ARRIVALS, lambda path, victim: path.symlink_to(victim)),
        (RECORD, session.ARRIVALS, lambda path, _: os.mkfifo(path)),
        (RUN, session.ARRIVALS, lambda path, _: path.symlink_to("/nowhere")),
    ],
)
def test_a_recording_overwrites_nothing_that_is_there_and_says_so_in_one_line(
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    command: tuple[str, str],
    name: str,
    make: Callable[[Path, Path], None],
) -> None:
    """The device is missing, too: nothing would be recorded."""
    hub = VirtualHub(tmp_path / "skin", MODULES, native=True)
    config = configured(tmp_path, hub)
    hub.unplug()
    out, victim = tmp_path / "session", tmp_path / "victim"
    out.mkdir()
    victim.write_bytes(BY_HAND)
    make(out / name, victim)
    assert main([*command, str(out), str(config)]) == 2
    errors = capfd.readouterr().err
    assert errors == f"{out / name}: is there already; name another directory for the recording\n"
    assert [path.name for path in out.iterdir()] == [name]
    assert victim.read_bytes() == BY_HAND
    assert not (out / name).is_file() or (out / name).read_bytes() == BY_HAND


def test_a_link_that_is_made_meanwhile_ends_the_recording_and_is_not_followed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    place, victim = tmp_path / "s", tmp_path / "victim"
    place.mkdir()
    with Recorder(place, moves=False) as recorder:
        (place / session.ARRIVALS).symlink_to(victim)
        recorder.take(frame(0))
        until(lambda: recorder.failed)
    assert not victim.exists()
    assert caplog.messages == [f"{place}: the recording has ended (File exists)"]


@pytest.mark.parametrize("is_full", [False, True])
def test_a_recording_whose_files_are_removed_has_ended_and_gives_the_disk_its_room_back(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, is_full: bool
) -> None:
    with disk(tmp_path / "disk") as small, Recorder(small.place / "s", moves=False) as recorder:
        recorder.take(frame(0))
        until(lambda: recorder.written == 1)
        if is_full:
            small.fill()
            recorder.take(Chunk(1.0, bytes(8192)))
            until(lambda: "waits" in caplog.text)
        shutil.rmtree(small.place / "s")
        until(lambda: recorder.failed)
        assert recorder.dropped == is_full
    assert caplog.messages[-1] == f"{small.place}/s: the recording has ended (its files are gone)"


@pytest.mark.parametrize("name", ["file/s", "s" * 300], ids=["below a file", "too long a name"])
def test_a_directory_that_cannot_be_made_is_one_line(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(SetupError, match=r"cannot be made[^\n]*$"):
        Recorder(tmp_path / name, moves=False)


def frame(number: int) -> Frame:
    return Frame(float(number), 0x101, bytes(8))


@pytest.mark.parametrize("stays_full", [False, True])
def test_a_full_disk_is_waited_for_and_costs_nothing_once_it_has_room_or_ends_the_recording(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, stays_full: bool
) -> None:
    sent = 400  # more than a page of the disk
    with disk(tmp_path / "disk") as small:
        place = small.place / "s"
        with Recorder(place, moves=False) as recorder:
            recorder.take(frame(0))
            until(lambda: recorder.written == 1)
            small.fill()
            for number in range(1, sent):
                recorder.take(frame(number))
            until(lambda: caplog.messages)
            if not stays_full:
                small.free()
                until(lambda: recorder.written == sent)
        waits = f"{place}: the recording waits (No space left on device)"
        ends = f"{place}: the recording has ended (No space left on device)"
        goes_on = [waits, f"{place}: the recording goes on"]
        assert caplog.messages == ([waits, ends] if stays_full else goes_on)
        frames = items_of(place)
    assert recorder.dropped == (sent - 1) * stays_full, "of a batch that began none counts"
    assert frames == [frame(k) for k in range(len(frames))]
    assert stays_full or len(frames) == sent


def test_a_disk_that_hangs_costs_records_and_never_the_caller(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    moves = threading.Event()
    moves.set()

    class Slow(recorders.FileIO):
        def write(self, data: bytes) -> int:  # type: ignore[override]
            assert moves.wait(PATIENCE_S)
            return super().write(data)

    monkeypatch.setattr(recorders, "FileIO", Slow)
    monkeypatch.setattr(recorders, "WAITING_BYTES", 100_000)
    with Recorder(tmp_path / "s", moves=False) as recorder:
        moves.clear()
        for number in range(2000):
            recorder.take(frame(number))  # in this thread, which the disk would stop for ever
        dropped = recorder.dropped
        recorder.take(Chunk(1.0, bytes(100_000)))  # bytes count, not records alone
        assert recorder.dropped == dropped + 1
        moves.set()
        until(lambda: recorder.written + dropped == 2000)
        recorder.take(frame(3000))
    assert 1000 < dropped < 2000
    assert items_of(tmp_path / "s")[-1] == frame(3000)


def test_all_that_is_recorded_is_synced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: set[str] = set()
    real = os.fsync

    def fsync(descriptor: int) -> None:
        synced.add(Path(f"/proc/self/fd/{descriptor}").readlink().name)
        real(descriptor)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(recorders, "SYNC_S", 0.0)
    with Recorder(tmp_path / "s", moves=True) as recorder:
        recorder.take(Chunk(1.0, b"\x00"))
        until(lambda: synced)
    assert synced == {session.ARRIVALS}


def test_what_was_recorded_replays_as_many_scans_as_were_taken(
    tmp_path: Path, hub: VirtualHub
) -> None:
    command = RECORD if hub.native else RUN
    out, config = tmp_path / "session", configured(tmp_path, hub)
    process = taxeld(*command, out, config, **PIPES)
    try:
        serve(hub, lambda: hub.scans >= 30)
        sent = hub.written
        serve(hub, lambda: recorded_bytes(out) >= sent)
    finally:
        process.terminate()
        said, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0
    assert (out / session.CONFIG).read_text("utf-8") == config.read_text("utf-8")
    scans = len(printed("replay", out).splitlines())
    assert scans >= 30
    assert command is RUN or f"{scans} scans, 0 sensor poses" in said
