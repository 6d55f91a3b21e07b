"""What skins and beliefs have learned, kept over restarts."""

import contextlib
import io
import itertools
import logging
import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from taxeld import files
from taxeld.config.file import parse
from taxeld.config.tables import SkinConfig
from taxeld.estimator.estimate import Estimate, Status
from taxeld.estimator.estimator import Estimator
from taxeld.estimator.evidence import MOVED
from taxeld.estimator.scans import ScanEvidence, scan_arrays, scans_of
from taxeld.layout.layout import Layout
from taxeld.model import se2
from taxeld.model.noise import Noise
from taxeld.model.observation import Observation, ObservationModel
from taxeld.service import kept
from taxeld.service.kept import NAME, Store, directory
from taxeld.service.loop import Daemon
from taxeld.skin.skin import Skin
from taxeld.stream import pair
from taxeld.stream.link import Link
from taxeld.stream.pair import Kind
from taxeld.worker import Worker
from tests.rig.clocks import until
from tests.rig.commands import refuses
from tests.rig.disks import disk
from tests.rig.memories import remembered
from tests.rig.pressed_box import TRUTH, World, box_side, estimator
from tests.rig.simulated_skin import SimulatedSkin

from .test_loop import settings

DAY_S = 86_400.0


@dataclass
class Run:
    """One run of a daemon's skin and belief, as far as they are kept."""

    place: Path
    skin: Skin
    estimator: Estimator
    is_touched: bool = False
    has_object: bool = True

    def __post_init__(self) -> None:
        text = f'[source]\nkind = "can"\nchannel = "can0"\n[skin]\nstate_dir = "{self.place}"\n'
        self.stages = [SimpleNamespace(skin=self.skin)]
        self.store = Store(parse(text), self)  # type: ignore[arg-type]
        self.store.restore()

    @property
    def stepped_s(self) -> float:
        return time.time() - self.skin._t

    def reset(self) -> None:
        self.estimator.reset()

    def end(self) -> None:
        self.store.close()


Begin = Callable[..., Run]


@pytest.fixture
def begin(skin: Layout, box_model: ObservationModel, tmp_path: Path) -> Iterator[Begin]:
    """Begins runs on one directory, one after another."""
    runs: list[Run] = []

    def begun(**keys: Any) -> Run:
        runs.append(Run(tmp_path / "state", Skin(skin, SkinConfig()), estimator(box_model, **keys)))
        return runs[-1]

    yield begun
    for run in runs:
        run.end()


def felt(run: Run) -> tuple[SimulatedSkin, World]:
    """What a run that has learned its skin has felt of the box."""
    simulated, world = SimulatedSkin(run.skin.layout), World(run.estimator.model)
    simulated.run(run.skin, 4.0)
    world.find(run.estimator, least=4)
    return simulated, world


def near(found: Estimate, truth: np.ndarray) -> bool:
    return bool(np.hypot(*(found.map - truth)[:2]) < 0.005)


@pytest.mark.parametrize("moved", [np.zeros(3), np.array([0.08, 0.03, 0.4])])
def test_a_restarted_skin_and_belief_know_what_they_knew_unless_the_object_was_moved(
    begin: Begin, moved: np.ndarray
) -> None:
    before = begin()
    simulated, world = felt(before)
    before.end()
    assert [path.name for path in before.place.iterdir()] == [NAME]
    after = begin()
    assert after.skin.on_scan(simulated.scan()) is not None
    assert np.abs(after.skin.baseline - before.skin.baseline).max() < 0.01
    waits = after.estimator.estimate
    assert near(waits, TRUTH)
    assert waits.contacts == before.estimator.estimate.contacts
    assert waits.status is not Status.CONVERGED
    assert waits.hypotheses.moved == pytest.approx(MOVED, abs=0.01)
    world.truth = se2.compose(TRUTH, moved)
    assert near(
        world.find(after.estimator, least=4), world.truth
    )  # two touches may fit both places


def test_a_restart_learns_the_silences_that_the_belief_remembers_however_many_came_since(
    begin: Begin,
) -> None:
    run = begin()
    world, model = World(run.estimator.model), run.estimator.model
    for angle in (0.2, 1.55):
        world.press(run.estimator, angle)
    for k in range(12):
        world.feel(run.estimator, box_side(model, 0.5 * k, -0.005))
    for k in range(40):  # where nothing was expected
        world.feel(run.estimator, np.array([0.25 + 0.006 * k, 0.2, 0.0]))
    world.press(run.estimator, 2.9)
    silent = [scan for scan in run.estimator.belief.memory.scans if not scan.is_contact]
    before_touch = [scan.observation.sensor for scan in silent if scan.number < 3]
    assert len(before_touch) > 3
    run.end()
    again = begin()
    found, is_silent = stored(again), ~stored(again)["belief.z"].any(axis=1)
    assert found["belief.sensor"][is_silent] == pytest.approx(np.array(before_touch))
    assert sum(not scan.is_contact for scan in again.estimator.belief.memory.scans) > 3


def test_scans_with_and_without_noise_of_links_of_two_sizes_come_back() -> None:
    one = Observation(np.array([1.0, 2.0, 3.0]), np.zeros(3), np.ones(3, bool), 0.25)
    own = Noise(np.full(2, 0.5), np.full(2, 0.25), 0.125)
    two = Observation(np.zeros(3), np.array([0.5, 0.0]), np.array([True, False]), noise=own, link=1)
    scans = [ScanEvidence(seen, 3, False, np.empty(0), 0.0, 0.0) for seen in (one, two)]
    (first, number), (second, _) = scans_of(scan_arrays(scans))
    assert (number, first.noise, first.link, second.link) == (3, None, 0, 1)
    assert first.floor == pytest.approx(np.full(3, 0.25))
    assert second.noise.sigma == pytest.approx(np.full(2, 0.5))
    assert second.noise.outliers == 0.125
    assert second.live.tolist() == [True, False]
    assert scans_of(scan_arrays([])) == []


@pytest.mark.parametrize(
    ("later_s", "keys", "says"),
    [
        (1000.0, {}, ["1000 s old: the object is to be found again"]),
        (1.0, {"seed": 12_345}, ["it is of another scene, skin or configuration: the object is"]),
        (DAY_S, {}, ["24.0 h old: the idle baseline is learned again", "s old: the object"]),
        (-DAY_S, {}, ["-24.0 h old: the idle baseline is learned again", "s old: the object"]),
    ],
)
def test_what_is_old_or_of_another_configuration_is_not_used_and_each_part_says_so(
    begin: Begin,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    later_s: float,
    keys: dict[str, Any],
    says: list[str],
) -> None:
    before = begin()
    simulated, _ = felt(before)
    before.end()
    clock = time.time
    monkeypatch.setattr(time, "time", lambda: clock() + later_s)
    with caplog.at_level(logging.WARNING):
        after = begin(**keys)
        assert len(caplog.messages) == len(says)
    assert all(part in line for part, line in zip(says, caplog.messages, strict=True))
    assert after.estimator.estimate.contacts == 0
    is_known = after.skin.on_scan(simulated.scan()) is not None
    assert is_known == (abs(later_s) < DAY_S)


def stored(run: Run) -> dict[str, Any]:
    """The arrays of the file as it is; none where there is no file."""
    try:
        with np.load(run.place / NAME) as arrays:
            return dict(arrays)
    except FileNotFoundError:
        return {}


def kept_now(run: Run, now_s: float) -> dict[str, Any]:
    """What is stored once the work of a pass at that time is done."""
    run.store.keep(now_s, time.time())
    until(lambda: not run.store._worker.behind)
    return stored(run)


@pytest.mark.parametrize("disk_is", ["well", "full", "read-only"])
@pytest.mark.parametrize("baselines", [False, True], ids=["reset", "tare"])
def test_what_is_forgotten_during_a_contact_is_pending_until_the_disk_forgets_it(
    begin: Begin, tmp_path: Path, disk_is: str, baselines: bool
) -> None:
    def is_forgotten(found: dict[str, Any]) -> bool:
        baseline = found.get("skin0.baseline", np.nan)
        return bool(np.isnan(baseline).all()) if baselines else "belief.z" not in found

    with disk(tmp_path / "state") as small:
        run = begin()
        felt(run)
        before = kept_now(run, 60.0)
        assert {"belief.z", "skin0.baseline"} < before.keys()
        {"well": small.free, "full": small.fill, "read-only": small.lock}[disk_is]()
        run.is_touched = True
        (run.skin.tare if baselines else run.estimator.reset)()
        run.store.forget(baselines=baselines)
        assert is_forgotten(kept_now(run, 60.1)) == (disk_is != "read-only")
        assert run.store.failed == (disk_is != "well")
        assert run.store.pending == (disk_is == "read-only")
        small.free()
        run.is_touched = disk_is == "read-only"
        kept_now(run, 60.1 + 0.9 * kept.AGAIN_S)
        assert run.store.pending == (disk_is == "read-only"), "not yet"
        after = kept_now(run, 60.1 + 1.1 * kept.AGAIN_S)
        assert run.store.pending == 0
        assert is_forgotten(after)
        assert after["skin0.response"] == pytest.approx(before["skin0.response"])
        run.end()


def test_a_skin_that_is_not_ready_keeps_what_was_stored_of_it(begin: Begin) -> None:
    before = begin()
    felt(before)
    before.end()
    after = begin()
    after.end()
    assert stored(after)["skin0.baseline"] == pytest.approx(before.skin.baseline)


@pytest.fixture(scope="module")
def whole(
    box_model: ObservationModel, skin: Layout, tmp_path_factory: pytest.TempPathFactory
) -> Callable[[], bytes]:
    """A file of a skin and of a belief; hypothesis prints a function by its name alone."""
    run = Run(tmp_path_factory.mktemp("kept"), Skin(skin, SkinConfig()), estimator(box_model))
    felt(run)
    run.end()
    file = (run.place / NAME).read_bytes()
    return lambda: file


LIST = -1  # in place of an offset: where a comment of 16 kB begins to hide the other arrays


@given(at=st.integers(0, 10**6), damage=st.none() | st.binary(min_size=1, max_size=40))
@example(at=LIST, damage=bytes([64]))
def test_a_file_with_any_damage_is_not_used_or_as_it_was(
    whole: Callable[[], bytes],
    tmp_path_factory: pytest.TempPathFactory,
    at: int,
    damage: bytes | None,
) -> None:
    """Without damage of its own it is cut."""
    file, path = whole(), tmp_path_factory.getbasetemp() / "d.npz"
    at = file.find(b"PK\x01\x02") + 33 if at == LIST else at % len(file)
    path.write_bytes(file[:at] + (b"" if damage is None else damage + file[at + len(damage) :]))
    found = kept.read(path)
    with np.load(io.BytesIO(file)) as arrays:
        assert not found or {name: found[name].tobytes() for name in found} == {
            name: arrays[name].tobytes() for name in arrays
        }


def misread(path: Path, whole: bytes) -> None:
    """A file with a scan of a link that is not there, where nothing looks for that."""
    with np.load(io.BytesIO(whole)) as arrays:
        np.savez(path, **dict(arrays) | {"belief.link": arrays["belief.link"] + 7})


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda path, _: path.mkdir(), "not used, it is no regular file"),
        (lambda path, _: os.mkfifo(path), "not used, it is no regular file"),
        (lambda path, _: path.write_bytes(b""), "not used, it is damaged"),
        (lambda path, _: path.write_bytes(b" " * (files.LARGEST + 1)), "not used, it is larger"),
        (lambda path, _: np.savez(path, version=0), "not used, it is of another version"),
        (misread, "set aside as failed.npz: it cannot be learned (IndexError"),
    ],
    ids=["a directory", "a pipe", "empty", "huge", "another version", "not to be learned"],
)
def test_what_cannot_be_used_is_one_warning_is_tried_once_and_keeps_nobody_waiting(
    begin: Begin,
    whole: Callable[[], bytes],
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    make: Any,
    reason: str,
) -> None:
    (tmp_path / "state").mkdir()
    make(tmp_path / "state" / NAME, whole())
    for lines in (1, 0):
        run = begin()
        assert [f"{NAME}: {reason}" in line for line in caplog.messages] == [True] * lines
        assert run.estimator.estimate.contacts == 0
        SimulatedSkin(run.skin.layout).run(run.skin, 2.0)
        if (run.place / NAME).is_dir():
            (run.place / NAME).rmdir()
        run.end()
        assert "skin0.baseline" in stored(run)
        caplog.clear()
    assert (run.place / kept.ASIDE).exists() == (make is misread)


def test_a_refused_start_leaves_the_kept_belief(whole: Callable[[], bytes], tmp_path: Path) -> None:
    (tmp_path / "state").mkdir()
    file = tmp_path / "state" / NAME
    file.write_bytes(whole())
    text = f'{settings(tmp_path)}[skin]\nstate_dir = "{tmp_path}/state"\n'
    with contextlib.closing(Daemon(parse(settings(tmp_path)))):
        refuses("another daemon serves", Daemon, parse(text))
    assert file.read_bytes() == whole()


def test_of_two_daemons_with_one_directory_the_second_keeps_nothing_and_says_so(
    begin: Begin, caplog: pytest.LogCaptureFixture
) -> None:
    first = begin()
    felt(first)
    before = kept_now(first, 60.0)
    second = begin()
    (line,) = caplog.messages
    assert line.startswith(f"{first.place}: not used, another daemon keeps its state there")
    felt(second)
    second.store.forget()
    assert kept_now(second, 60.0).keys() == before.keys()
    second.end()
    assert stored(first)["belief.t"] == before["belief.t"]
    assert (second.store.failed, second.store.pending) == (1, 0)


def test_the_file_is_written_through_no_link(begin: Begin, tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_text("by hand", encoding="utf-8")
    (tmp_path / "state").mkdir()
    for name in (NAME, "kept.new"):
        (tmp_path / "state" / name).symlink_to(victim)
    run = begin()
    felt(run)
    run.end()
    assert victim.read_text(encoding="utf-8") == "by hand"
    assert [(path.name, path.is_symlink()) for path in run.place.iterdir()] == [(NAME, False)]


def test_writing_is_seldom_and_waits_for_the_end_of_a_touch(
    begin: Begin, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = begin()
    simulated, offered = SimulatedSkin(run.skin.layout), []
    monkeypatch.setattr(Worker, "give", lambda *_: offered.append(now_s))
    for k in range(20 * 400):
        now_s = 0.05 * k
        simulated.press[3] = 5_000.0 if 230.0 < now_s < 290.0 else 0.0
        run.skin.on_scan(simulated.scan())
        run.is_touched = run.skin.touched
        run.store.keep(now_s, time.time())
    first, later = offered
    assert first == pytest.approx(1.0, abs=0.06)  # the end of the capture
    assert later == pytest.approx(290.0, abs=0.3)


def test_a_slow_disk_holds_nothing_up_not_even_the_end_and_gets_the_newest(
    begin: Begin, monkeypatch: pytest.MonkeyPatch
) -> None:
    free, syncing = threading.Event(), threading.Event()

    def slow(_: int) -> None:
        syncing.set()
        assert free.wait(30.0)

    monkeypatch.setattr(os, "fsync", slow)
    run = begin()
    simulated, _ = felt(run)
    run.store.keep(0.0, time.time())
    assert syncing.wait(30.0)
    for k in range(1, 50):
        simulated.run(run.skin, 0.05)
        run.store.keep(k * kept.AT_LEAST_S, time.time())
    assert run.store._worker.behind == 1
    monkeypatch.setattr(kept, "CLOSE_S", 0.05)
    run.end()
    assert not stored(run)
    free.set()
    until(lambda: not run.store._worker.behind)
    assert stored(run)["skin0.baseline"] == pytest.approx(run.skin.baseline)


def test_each_change_of_what_the_disk_takes_is_logged_and_each_failure_counted(
    begin: Begin, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with disk(tmp_path / "state") as small:
        run = begin()
        felt(run)
        for number, happens in enumerate((small.lock, small.lock, small.free, small.lock)):
            happens()
            kept_now(run, 300.0 * number)
        run.end()
    fails = f"{run.place}/{NAME}: not written (Read-only file system)"
    assert caplog.messages == [fails, f"{run.place}/{NAME}: written again", fails]
    assert run.store.failed == 4


def test_each_door_is_handed_what_was_felt_out_of_contact_at_most_once_a_second(
    begin: Begin,
) -> None:
    run, relay = begin(), Link({}, lambda *_: None, {})
    link = Link({}, lambda *_: None, {}, relay)
    _, world = felt(run)
    for began_s, step_s, each in ((0.0, 1.0, link), (1e6, 1.0, link), (2e6, 0.0, relay)):
        loops, door = pair.open_pair()
        each.attach(loops, began_s)
        each.is_ready = pair.receive(door) is not None  # who speaks
        run.is_touched = True
        run.store.remember(link, began_s)
        run.is_touched = False
        assert not run.store._worker.behind
        passes = map(partial(run.store.remember, link), itertools.count(began_s, step_s))
        kind, (scans,) = until(partial(pair.receive, door), passes.__next__)
        assert kind == Kind.MEMORY
        with np.load(io.BytesIO(scans)) as handed:
            told = remembered(run.estimator)
            assert handed.keys() == told.keys()
            assert all(handed[name].tobytes() == told[name].tobytes() for name in told)
        door.close()
    world.find(run.estimator, least=1)
    run.store.remember(link, began_s + 0.9 * kept.MEMORY_S)
    assert not run.store._worker.behind
    for each in link.doors:
        each.detach()


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
    assert directory(parse(source + text)) == (Path(where) if where else None)
