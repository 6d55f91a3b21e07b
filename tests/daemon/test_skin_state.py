"""What a skin has learned, kept over restarts."""

import json
import logging
import os
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from taxeld.config.file import parse
from taxeld.config.tables import SkinConfig
from taxeld.layout.layout import Layout
from taxeld.service import kept_file, state_file
from taxeld.service.state_file import NAME, StateFile
from taxeld.skin.skin import Skin
from taxeld.skin.state import SkinState
from tests.rig.simulated_skin import SimulatedSkin

HELD = [3, 4]
DAY_S = 86_400.0


def begun(skin: Layout) -> tuple[SimulatedSkin, Skin]:
    simulated, subject = SimulatedSkin(skin), Skin(skin, SkinConfig())
    simulated.run(subject, 4.0)
    return simulated, subject


def state_of(subject: Skin) -> SkinState:
    state = subject.state()
    assert state is not None
    return state


def restarted(skin: Layout, state: SkinState) -> Skin:
    subject = Skin(skin, SkinConfig())
    subject.restore(state)
    return subject


def test_a_restarted_skin_feels_from_the_first_scan_though_it_is_held(skin: Layout) -> None:
    simulated, before = begun(skin)
    simulated.press[HELD] = 5_000.0
    subject = restarted(skin, state_of(before))
    activation = subject.on_scan(simulated.scan())
    assert activation is not None
    assert np.flatnonzero(activation.z).tolist() == HELD
    assert activation.z[HELD] == pytest.approx(0.25, abs=0.01)
    assert activation.live.all()
    assert subject.threshold == pytest.approx(before.threshold, abs=0.1)


@pytest.mark.parametrize(
    "happened",
    [
        lambda simulated: simulated.base.__iadd__(3_000.0),
        lambda simulated: simulated.base.__isub__(3_000.0),
        lambda simulated: simulated.rng.shuffle(simulated.base),
        lambda simulated: simulated.press.__iadd__(5_000.0),
    ],
)
def test_a_baseline_that_the_skin_does_not_bear_out_is_captured_afresh(
    skin: Layout, happened: Callable[[SimulatedSkin], None]
) -> None:
    simulated, before = begun(skin)
    happened(simulated)
    subject = restarted(skin, state_of(before))
    assert subject.on_scan(simulated.scan()) is None
    simulated.run(subject, 3.0)
    reads = simulated.base + simulated.press
    assert np.abs(subject.baseline - reads).max() < 50.0


def test_what_t0_explains_of_the_time_between_is_taken_off(skin: Layout) -> None:
    simulated, before = begun(skin)
    state = replace(state_of(before), coefficient=np.full(4, 0.5))
    simulated.coefficient, simulated.warmth = 0.5, lambda t: 1_000.0 + 0.0 * t
    simulated.press[HELD] = 5_000.0
    subject = restarted(skin, replace(state, leak=np.full(4, 0.04)))
    activation = subject.on_scan(simulated.scan())
    assert activation is not None
    assert np.flatnonzero(activation.z).tolist() == HELD
    assert activation.z[HELD] == pytest.approx(0.25, abs=0.01)


def test_what_was_dead_is_judged_when_it_speaks_and_a_first_scan_may_be_torn(
    skin: Layout,
) -> None:
    simulated, before = begun(skin)
    subject = restarted(skin, state_of(before))
    torn = simulated.scan()
    few = (*torn.counts[:12], *[-1] * (len(torn.counts) - 12))
    assert subject.on_scan(replace(torn, counts=few)) is None
    simulated.fixed[7] = 0
    activation = subject.on_scan(simulated.scan())
    assert activation is not None
    assert np.flatnonzero(~activation.live).tolist() == [7]
    del simulated.fixed[7]
    assert simulated.run(subject, 0.1).live.all()


def test_tare_forgets_what_was_stored(skin: Layout) -> None:
    simulated, before = begun(skin)
    subject = restarted(skin, state_of(before))
    subject.tare()
    assert subject.on_scan(simulated.scan()) is None
    simulated.run(subject, 2.0)


def text_of(skin: Layout, at: float, /, **changes: object) -> bytes:
    data = json.loads(state_file.dump(replace(state_of(begun(skin)[1]), t=at)))
    return json.dumps({**data, **changes}).encode()


FAULTS: list[tuple[str, Callable[[Layout, float], bytes], str]] = [
    ("empty", lambda _s, _t: b"", "it is damaged"),
    ("torn", lambda s, t: text_of(s, t)[:200], "it is damaged"),
    ("deep", lambda _s, _t: b"[" * 100_000, "it is damaged"),
    ("version", lambda s, t: text_of(s, t, version=1), "it is of another skin or version"),
    ("skin", lambda s, t: text_of(s, t, digest="0" * 16), "it is of another skin or version"),
    ("time", lambda s, t: text_of(s, t, t=float("nan")), "it is nan h old"),
    ("count", lambda s, t: text_of(s, t, baseline=[10**400] * 32), "it is damaged"),
    ("short", lambda s, t: text_of(s, t, noise=[1.0] * 31), "it is damaged"),
    ("range", lambda s, t: text_of(s, t, leak=[7.0] * 4), "it is damaged"),
    ("gap", lambda s, t: text_of(s, t, coefficient=[None] * 4), "it is damaged"),
    ("old", lambda s, t: text_of(s, t - DAY_S), "it is 24.0 h old"),
    ("future", lambda s, t: text_of(s, t + DAY_S), "it is -24.0 h old"),
    ("huge", lambda _s, _t: b" " * 2_000_000, "it is larger than 1000000 bytes"),
]


@pytest.mark.parametrize(("make", "fault"), [f[1:] for f in FAULTS], ids=[f[0] for f in FAULTS])
def test_a_file_that_cannot_be_used_is_one_warning_and_a_fresh_capture(
    skin: Layout,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    make: Callable[[Layout, float], bytes],
    fault: str,
) -> None:
    now = 1e9
    (tmp_path / NAME).write_bytes(make(skin, now))
    simulated, subject = SimulatedSkin(skin), Skin(skin, SkinConfig())
    kept = StateFile(tmp_path, subject, subject.state)
    with caplog.at_level(logging.WARNING):
        kept.restore(now)
    (line,) = caplog.messages
    assert fault in line
    assert "\n" not in line
    assert subject.is_ready is False
    simulated.run(subject, 2.0)


@pytest.mark.parametrize("make", [Path.mkdir, os.mkfifo], ids=["a directory", "a pipe"])
def test_what_is_no_file_in_its_place_is_one_warning_and_keeps_nobody_waiting(
    skin: Layout, tmp_path: Path, caplog: pytest.LogCaptureFixture, make: Callable[[Path], None]
) -> None:
    make(tmp_path / NAME)
    subject = begun(skin)[1]
    StateFile(tmp_path, subject, subject.state).restore(1e9)
    (line,) = caplog.messages
    assert "not used, it is no regular file" in line


def test_a_state_is_written_through_no_link(skin: Layout, tmp_path: Path) -> None:
    place, victim = tmp_path / "state", tmp_path / "victim"
    place.mkdir()
    victim.write_text("by hand", encoding="utf-8")
    for name in (NAME, "skin.new"):
        (place / name).symlink_to(victim)
    subject = begun(skin)[1]
    kept = StateFile(place, subject, subject.state)
    kept.close()
    assert victim.read_text(encoding="utf-8") == "by hand"
    assert [(path.name, path.is_symlink()) for path in place.iterdir()] == [(NAME, False)]


def test_what_is_kept_is_what_is_restored(skin: Layout, tmp_path: Path) -> None:
    simulated, before = begun(skin)
    kept = StateFile(tmp_path / "made", before, before.state)
    kept.restore(simulated.t)
    kept.close()
    assert [path.name for path in (tmp_path / "made").iterdir()] == [NAME]
    after = Skin(skin, SkinConfig())
    again = StateFile(tmp_path / "made", after, after.state)
    again.restore(simulated.t + 3_600.0)
    activation = after.on_scan(simulated.scan())
    assert activation is not None
    assert np.abs(after.baseline - before.baseline).max() < 0.01


def test_writing_is_seldom_and_waits_for_the_end_of_a_touch(skin: Layout, tmp_path: Path) -> None:
    simulated, subject = SimulatedSkin(skin), Skin(skin, SkinConfig())
    offered: list[float] = []

    def state() -> None:
        offered.append(state_of(subject).t)

    kept = StateFile(tmp_path, subject, state)
    for k in range(20 * 700):
        simulated.press[3] = 5_000.0 if 250.0 < 0.05 * k < 320.0 else 0.0
        subject.on_scan(simulated.scan())
        if subject.is_ready:
            kept.keep(0.05 * k)
    begin, later, last = (t - 100.0 for t in offered)
    assert begin == pytest.approx(1.0, abs=0.06)  # the end of the capture
    assert later == pytest.approx(320.0, abs=0.2)
    assert last == pytest.approx(620.0, abs=0.3)


def test_a_slow_disk_holds_nothing_up_and_gets_the_newest(
    skin: Layout, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    free, syncing = threading.Event(), threading.Event()

    writings: list[int] = []

    def slow(descriptor: int) -> None:
        writings.append(descriptor)
        syncing.set()
        assert free.wait(30.0)

    monkeypatch.setattr(os, "fsync", slow)
    simulated, subject = begun(skin)
    kept = StateFile(tmp_path, subject, subject.state)
    kept.keep(0.0)
    assert syncing.wait(30.0)
    for k in range(1, 50):
        simulated.run(subject, 0.05)
        kept.keep(k * state_file.EVERY_S)
    assert not (tmp_path / NAME).exists()
    free.set()
    kept.close()
    assert len(writings) <= 3
    assert json.loads((tmp_path / NAME).read_bytes())["t"] == pytest.approx(simulated.t, abs=1e-3)


def test_a_disk_that_hangs_does_not_keep_the_daemon_from_ending(
    skin: Layout, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kept_file, "CLOSE_S", 0.05)
    free = threading.Event()
    monkeypatch.setattr(os, "fsync", lambda _: free.wait(30.0))
    subject = begun(skin)[1]
    kept = StateFile(tmp_path, subject, subject.state)
    kept.close()
    assert not (tmp_path / NAME).exists()
    free.set()


def test_a_disk_that_takes_nothing_is_one_warning(
    skin: Layout,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    tried: list[int] = []

    def full(descriptor: int) -> None:
        tried.append(descriptor)
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    subject = begun(skin)[1]
    kept = StateFile(tmp_path, subject, subject.state)
    with caplog.at_level(logging.WARNING):
        for failed in (1, 2):
            deadline = time.monotonic() + 30.0
            while len(tried) < failed and time.monotonic() < deadline:
                kept.keep(failed * state_file.EVERY_S)
                time.sleep(0.002)
    kept.close()
    assert len(tried) == 3
    (line,) = caplog.messages
    assert line.endswith("not written (No space left on device)")
    assert not (tmp_path / NAME).exists()


@pytest.mark.parametrize(
    ("text", "variable", "where"),
    [
        ("", "", None),
        ("", "/var/lib/taxeld/a:/var/lib/b", "/var/lib/taxeld/a"),
        ('[skin]\nstate_dir = "/tmp/c"\n', "/var/lib/a", "/tmp/c"),  # noqa: S108
    ],
)
def test_the_place_is_the_configured_one_or_systemds(
    monkeypatch: pytest.MonkeyPatch, text: str, variable: str, where: str | None
) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", variable)
    source = '[source]\nkind = "can"\nchannel = "can0"\n[scene]\nbundle = "box"\n'
    assert state_file.directory(parse(source + text)) == (Path(where) if where else None)
