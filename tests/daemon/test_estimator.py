"""The estimator: what it learns from, and that nothing it is given brings it down."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from taxeld import messages, se2
from taxeld.config import FilterConfig
from taxeld.estimator import Estimate, Estimator, Status
from taxeld.observation import ObservationModel
from taxeld.poses import PoseTrack
from taxeld.proposals import Projection
from taxeld.skin import Activation

TRUTH = np.array([0.1, 0.05, 0.3])


def estimator(model: ObservationModel, **keys: int) -> Estimator:
    return Estimator(model, Projection(model), FilterConfig(**keys))


def feel(model: ObservationModel, sensor: np.ndarray, t: float) -> Activation:
    seen = se2.compose(se2.inverse(sensor), TRUTH)
    z = model.activation(seen[None])[0]
    return Activation(t, np.where(z > 0.02, z, 0.0), np.ones(len(z), dtype=bool))


def press(gap_m: float) -> np.ndarray:
    """A sensor pose that far from the box's long face, on its x axis."""
    return se2.compose(TRUTH, np.array([0.03 + 0.04 + gap_m, 0.01, 0.0]))


def approach(subject: Estimator, model: ObservationModel, t: float = 0.0) -> Estimate:
    """A press of 4 mm in steps of 1 mm; → the estimate when it is held."""
    for gap in (0.02, 0.01, 0.002, -0.001, -0.002, -0.003, -0.004, -0.004):
        subject.on_scan(feel(model, press(gap), t), press(gap))
        t += 0.05
    return subject.estimate


def sharpness(estimate: Estimate) -> tuple[float, float]:
    return estimate.ess, float(np.trace(estimate.cov))


def test_a_held_contact_counts_once(box_model: ObservationModel) -> None:
    """Ten minutes at 20 Hz of the same touch leave the belief as it was."""
    subject = estimator(box_model)
    before = approach(subject, box_model)
    updates = subject.counters.updates
    for k in range(12_000):
        after = subject.on_scan(feel(box_model, press(-0.004), 1.0 + 0.05 * k), press(-0.004))
    assert subject.counters.updates == updates
    assert sharpness(after) == sharpness(before)
    assert after.contacts == 1
    assert after.contact


def test_a_held_contact_with_noise_counts_once_as_well(box_model: ObservationModel) -> None:
    subject, rng = estimator(box_model), np.random.default_rng(0)
    approach(subject, box_model)
    updates = subject.counters.updates
    for k in range(2000):
        felt = feel(box_model, press(-0.004), 1.0 + 0.05 * k)
        z = np.clip(
            felt.z + np.where(felt.z > 0, 0.005 * rng.standard_normal(len(felt.z)), 0), 0, 1
        )
        subject.on_scan(Activation(felt.t, z, felt.live), press(-0.004))
    assert subject.counters.updates == updates


def test_a_press_is_judged_when_it_stops_deepening(box_model: ObservationModel) -> None:
    subject = estimator(box_model)
    judged = []
    for k, gap in enumerate((0.02, -0.001, -0.002, -0.003, -0.004, -0.004, -0.004)):
        estimate = subject.on_scan(feel(box_model, press(gap), 0.05 * k), press(gap))
        judged.append(estimate.injected > 0)
    assert judged == [False] * 5 + [True, False]


def test_a_flicker_does_not_begin_a_contact(box_model: ObservationModel) -> None:
    subject = estimator(box_model)
    approach(subject, box_model)
    silent = Activation(0.4, np.zeros(32), np.ones(32, dtype=bool))
    assert subject.on_scan(silent, press(-0.004)).contact
    assert subject.on_scan(feel(box_model, press(-0.004), 0.45), press(-0.004)).contacts == 1
    assert not subject.on_scan(replace(silent, t=1.5), press(0.01)).contact
    assert subject.on_scan(feel(box_model, press(-0.004), 1.6), press(-0.004)).contacts == 2


def test_touching_nothing_is_evidence(box_model: ObservationModel) -> None:
    """Silence where particles expect touch removes their weight."""
    subject = estimator(box_model)
    subject.belief.pose[:] = [0.0, 0.0, 0.0]
    subject.belief.pose[:50] = [0.5, 0.5, 0.0]
    sensor = np.array([0.068, 0.0, 0.0])  # pressed 2 mm by the half that stands at the origin
    subject.on_scan(Activation(0.0, np.zeros(32), np.ones(32, dtype=bool)), sensor)
    weight = subject.belief.weight
    near = np.hypot(*subject.belief.pose[:, :2].T) < 0.2
    assert weight[near].sum() < 0.01


def test_same_seed_same_bytes(box_model: ObservationModel) -> None:
    def run(seed: int) -> str:
        subject = estimator(box_model, seed=seed)
        return json.dumps(messages.estimate(approach(subject, box_model), seq=0, valid=True))

    assert run(3) == run(3)
    assert run(3) != run(4)


def test_reset_begins_anew(box_model: ObservationModel) -> None:
    subject = estimator(box_model)
    first = json.dumps(messages.estimate(approach(subject, box_model), seq=0, valid=True))
    subject.reset()
    assert subject.estimate.contacts == 0
    again = json.dumps(messages.estimate(approach(subject, box_model), seq=0, valid=True))
    assert again == first


def test_without_live_taxels_it_is_blind(box_model: ObservationModel) -> None:
    subject = estimator(box_model)
    dead = Activation(0.0, np.ones(32), np.zeros(32, dtype=bool))
    assert subject.on_scan(dead, np.zeros(3)).status is Status.BLIND


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_counted(box_model: ObservationModel, bad: float) -> None:
    subject = estimator(box_model)
    z, live = np.zeros(32), np.ones(32, dtype=bool)
    z[3] = bad
    subject.on_scan(Activation(0.0, z, live), np.zeros(3))
    subject.on_scan(Activation(0.0, np.zeros(32), live), np.array([0.0, bad, 0.0]))
    assert subject.counters.bad_input == 2
    assert np.isfinite(subject.belief.pose).all()


scans = st.tuples(
    st.floats(-1, 100),
    st.lists(st.sampled_from([0.0, 0.01, 0.5, 1.0, 7.0, -3.0, np.nan]), min_size=32, max_size=32),
    st.lists(st.booleans(), min_size=32, max_size=32),
    st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(-9, 9)),
)


@settings(max_examples=60, deadline=None)
@given(st.lists(scans, max_size=12), st.integers(2, 20), st.integers(0, 30))
def test_any_sequence_leaves_a_finite_belief(box_model: ObservationModel, sequence, n, s) -> None:  # type: ignore[no-untyped-def]
    subject = estimator(box_model, particles=n, injected=s)
    for t, z, live, sensor in sequence:
        estimate = subject.on_scan(Activation(t, np.array(z), np.array(live)), np.array(sensor))
        assert np.isfinite([*estimate.map, *estimate.mean, estimate.ess]).all()
        assert np.isfinite(estimate.cov).all()
    assert len(subject.belief) == n
    assert np.isclose(subject.belief.weight.sum(), 1.0)
    assert np.isfinite(subject.belief.pose).all()


def test_poses_are_interpolated_through_the_turn() -> None:
    track = PoseTrack(max_age_s=0.2)
    track.add(1.0, 0.0, 0.0, 3.1)
    track.add(1.1, 0.1, -0.2, -3.1)
    pose = track.at(1.05)
    assert pose is not None
    assert np.allclose(pose[:2], [0.05, -0.1])
    assert np.isclose(abs(pose[2]), np.pi)


@pytest.mark.parametrize(("t", "known"), [(0.9, False), (1.0, True), (1.3, True), (1.31, False)])
def test_a_pose_too_old_or_too_young_is_none(t: float, known: bool) -> None:
    track = PoseTrack(max_age_s=0.2)
    track.add(1.0, 0.0, 0.0, 0.0)
    track.add(1.1, 0.0, 0.0, 0.0)
    assert (track.at(t) is not None) == known


def test_poses_back_in_time_or_not_finite_are_rejected() -> None:
    track = PoseTrack(max_age_s=0.2)
    track.add(1.0, 0.0, 0.0, 0.0)
    for row in ((1.0, 1, 1, 1), (0.5, 1, 1, 1), (2.0, np.nan, 0, 0), (np.nan, 0, 0, 0)):
        track.add(*row)
    assert track.rejected == 4
    assert track.latest_t == 1.0


def test_without_a_memory_injection_is_algorithm_1(box_model: ObservationModel) -> None:
    """Nothing is remembered, so samples take the mean weight and nothing more."""
    subject = estimator(box_model, memory=0)
    approach(subject, box_model)
    assert subject.counters.injections == 1
    assert len(subject.memory) == 0
    assert subject.belief.remembered.shape == (100, 0)


def test_the_memory_is_bounded(box_model: ObservationModel) -> None:
    subject = estimator(box_model, memory=3)
    for k in range(6):
        approach(subject, box_model, t=10.0 * k)
    assert len(subject.memory) == 3
    assert subject.belief.remembered.shape == (100, 3)
    assert np.allclose(subject.memory.explain(subject.belief.pose), subject.belief.remembered)
