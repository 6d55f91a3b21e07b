"""What was felt, kept over restarts."""

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from taxeld.estimator.estimate import Estimate, Status
from taxeld.estimator.estimator import Estimator
from taxeld.estimator.history import MOVED
from taxeld.model import se2
from taxeld.model.observation import ObservationModel
from taxeld.service.belief_file import BeliefFile, Form, dump, parse
from tests.rig.clocks import until
from tests.rig.pressed_box import TRUTH, World, estimator

SIDES = (0.2, 1.3, 2.9, 4.5, 3.6, 5.2)


def felt(model: ObservationModel) -> tuple[Estimator, World]:
    subject, world = estimator(model), World(model)
    for side in SIDES:
        world.press(subject, side)
    return subject, world


def restarted(model: ObservationModel, before: Estimator, place: Path) -> Estimator:
    BeliefFile(place, before).close(1000.0)
    after = estimator(model)
    after.restore(BeliefFile(place, after).read(1060.0))
    return after


@pytest.fixture(scope="module")
def written(box_model: ObservationModel) -> Callable[[], tuple[bytes, Form]]:
    """What gives a file: hypothesis prints a function by its name alone."""
    subject, _ = felt(box_model)
    file = dump(subject.history.kept(), 1.0, Form.of(subject)), Form.of(subject)
    return lambda: file


def near(found: Estimate, truth: np.ndarray) -> bool:
    return bool(np.hypot(*(found.map - truth)[:2]) < 0.005)


def test_a_restarted_belief_is_sure_at_the_first_touch(
    box_model: ObservationModel, tmp_path: Path
) -> None:
    before, world = felt(box_model)
    after = restarted(box_model, before, tmp_path)
    waits = after.estimate
    assert near(waits, TRUTH)
    assert waits.contacts == before.estimate.contacts
    assert waits.status is not Status.CONVERGED
    assert waits.hypotheses.moved == pytest.approx(MOVED, abs=0.01)
    found = world.press(after, 2.0)
    assert found.status is Status.CONVERGED
    assert near(found, TRUTH)


def test_an_object_that_was_moved_meanwhile_is_not_believed_to_stand(
    box_model: ObservationModel, tmp_path: Path
) -> None:
    before, world = felt(box_model)
    after = restarted(box_model, before, tmp_path)
    world.truth = se2.compose(TRUTH, np.array([0.08, 0.03, 0.4]))
    for side in SIDES:
        found = world.press(after, side)
        assert found.status is not Status.CONVERGED or near(found, world.truth)
    assert found.status is Status.CONVERGED


def test_a_file_that_is_old_or_foreign_is_not_used(
    box_model: ObservationModel, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    before, _ = felt(box_model)
    BeliefFile(tmp_path, before).close(1000.0)
    other = estimator(box_model, seed=1)
    for subject, now, says in ((before, 2000.0, "s old"), (other, 1001.0, "another scene")):
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            assert BeliefFile(tmp_path, subject).read(now) == []
        assert says in caplog.text
    assert not BeliefFile(None, before).read(1001.0)


def test_what_is_reset_is_forgotten_by_the_next_pass(
    box_model: ObservationModel, tmp_path: Path
) -> None:
    before, _ = felt(box_model)
    kept = BeliefFile(tmp_path, before)
    kept.keep(60.0, 1000.0)
    until(lambda: len(kept.read(1001.0)) > 0)
    before.reset()
    kept.forget()
    until(lambda: not kept.read(1001.0), lambda: kept.keep(60.1, 1000.1))


def test_what_is_reset_during_a_contact_is_forgotten_as_well(
    box_model: ObservationModel, tmp_path: Path
) -> None:
    before, _ = felt(box_model)
    kept = BeliefFile(tmp_path, before)
    kept.keep(60.0, 1000.0)
    until(lambda: len(kept.read(1001.0)) > 0)
    before.reset()
    kept.forget()
    before.estimate = replace(before.estimate, contact=True)
    until(lambda: not kept.read(1001.0), lambda: kept.keep(60.1, 1000.1))


def test_a_number_that_signals_is_damage(written: Callable[[], tuple[bytes, Form]]) -> None:
    data, form = written()
    head, _, body = data.partition(b"\n")
    signals = b"\x01\x00\x80\x7f"  # a NaN whose conversion numpy warns of
    with pytest.raises(ValueError, match="damaged"):
        parse(head + b"\n" + signals * (len(body) // 4), form)


@given(at=st.integers(0, 10**6), damage=st.binary(min_size=1, max_size=40), cut=st.booleans())
@example(at=10130, damage=b"\x00\x00\x00\x00\x81", cut=False)
def test_no_damage_ends_the_daemon(
    written: Callable[[], tuple[bytes, Form]], at: int, damage: bytes, *, cut: bool
) -> None:
    data, form = written()
    at %= len(data)
    damaged = data[:at] + damage + (b"" if cut else data[at + len(damage) :])
    try:
        t, scans = parse(damaged, form)
    except ValueError:
        return
    assert np.isfinite(t)
    assert all(np.isfinite(scan.z).all() for scan, _ in scans)
