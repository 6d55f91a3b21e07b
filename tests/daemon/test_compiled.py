"""The C code explains what numpy explains."""

from pathlib import Path

import numpy as np
import pytest

from taxeld import native
from taxeld.estimator.memory import Memory, Slack
from taxeld.model import contacts
from taxeld.model.noise import Noise
from taxeld.model.observation import Observation, ObservationModel

EXPLAIN = "estimator/explain"
RING = "cylinder:columns=16,radius_m=0.04,pitch_m=0.01"
needed = pytest.mark.skipif(
    native.library(EXPLAIN) is None, reason="taxeld was installed without a C compiler"
)


def touched(model: ObservationModel, noise: Noise, slack: Slack, seed: int) -> Memory:
    """Scans of presses and silent ones, dead taxels, floors and residues among them."""
    rng = np.random.default_rng(seed)
    memory = Memory(model, noise, slack=slack)
    for number in range(1, 9):
        sensor = rng.normal(size=3) * [0.05, 0.05, 1.0]
        made = contacts.synthesise(model.scene, 0.04, model.depth_max_m, 20, rng)
        seen = made.pose[:1]  # some of the twenty miss the object
        z = noise.draw(model.activation(seen)[0], rng) * (rng.random() < 0.7)
        floor = np.where(rng.random(len(z)) < 0.2, 0.1, 0.02)
        live = rng.random(len(z)) < 0.9
        residue = 0.1 * rng.random(len(z))
        z = np.where(live & (z >= floor), z, 0.0)
        memory = memory.plus(Observation(sensor, z, live, floor, residue), number)
    return memory


@needed
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300])
def test_poses_that_are_none_are_explained_by_something(
    box_model: ObservationModel, value: float
) -> None:
    memory = touched(box_model, Noise(), Slack(0.001, 0.001), 0)
    for column in range(3):
        poses = np.zeros((1, 3))
        poses[0, column] = value
        assert memory.explain(poses).shape == (1, len(memory))


def test_no_poses_and_no_scans_are_explained(box_model: ObservationModel) -> None:
    assert touched(box_model, Noise(), Slack(), 0).explain(np.empty((0, 3))).shape == (0, 8)
    assert Memory(box_model, Noise()).explain(np.zeros((4, 3))).shape == (4, 0)


@needed
@pytest.mark.parametrize(
    ("library", "source"),
    [
        pytest.param(None, b"/* changed */", id="changed since"),
        pytest.param(b"\0" * 100, b"", id="no library"),
        pytest.param(b"", b"", id="empty"),
    ],
)
def test_a_library_of_other_code_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, library: bytes | None, source: bytes
) -> None:
    at = native.HERE / EXPLAIN
    made = tmp_path / "explain.so"
    made.write_bytes(at.with_suffix(".so").read_bytes() if library is None else library)
    made.with_suffix(".c").write_bytes(at.with_suffix(".c").read_bytes() + source)
    monkeypatch.setattr(native, "HERE", tmp_path)
    assert native.library.__wrapped__("explain") is None
    if library is None:
        made.with_suffix(".c").write_bytes(at.with_suffix(".c").read_bytes())
        assert native.library.__wrapped__("explain") is not None


LEAST, MOST = np.array([[0.02, 0.05, 0.0, 0.1], [0.05, 0.2, 0.005, 1.0]])[:, :, None]
UNEVEN = np.random.default_rng(7).uniform(LEAST, MOST, (4, 32))  # of a ring's taxels


@needed
@pytest.mark.parametrize("slack", [Slack(), Slack(0.001, 0.001)])
@pytest.mark.parametrize(
    "noise",
    [Noise(), Noise(0.04, sag_m=0.002, sag_sd=0.9), Noise(*UNEVEN[:2], 0.01, *UNEVEN[2:])],
    ids=["no sag", "sag", "each taxel its own"],
)
def test_c_explains_what_numpy_explains(
    box_model: ObservationModel, monkeypatch: pytest.MonkeyPatch, noise: Noise, slack: Slack
) -> None:
    poses = np.random.default_rng(1).normal(size=(400, 3)) * [0.06, 0.06, 2.0]
    by_c = touched(box_model, noise, slack, 0).explain(poses)
    monkeypatch.setenv(native.SWITCH, "0")
    native.library.cache_clear()
    by_numpy = touched(box_model, noise, slack, 0).explain(poses)
    native.library.cache_clear()
    assert (by_c != by_numpy).any()
    apart = ~np.isclose(by_c, by_numpy, atol=0.01)
    assert apart.mean() < 2e-3  # rounding decides whether a taxel is at the edge of a press
