"""The C code explains what numpy explains."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from taxeld import native
from taxeld.estimator.memory import Memory, Prior, Slack
from taxeld.estimator.particles import Needed
from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld.model import contacts
from taxeld.model.observation import Noise, Observation, ObservationModel
from taxeld.model.symmetry import PoseMetric

from .conftest import box, scene_of

SESSION = Path(__file__).parent / "session"
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
        memory.add(Observation(sensor, z, live, floor, residue), number)
    return memory


@needed
@settings(max_examples=30, deadline=None)
@given(
    st.integers(0, 2**16),
    st.sampled_from([0.0, 0.0005, 0.003]),
    st.sampled_from([0.0, 0.5, 2.0]),
    st.sampled_from([0.0, 0.01, 0.2]),
)
def test_c_and_numpy_explain_alike(
    box_model: ObservationModel, seed: int, robot_m: float, scale: float, outliers: float
) -> None:
    noise = Noise(0.04, 0.17, outliers)
    memory = touched(box_model, noise, Slack(robot_m, 0.001, scale), seed)
    rng = np.random.default_rng(seed)
    poses = rng.normal(size=(60, 3)) * [0.1, 0.1, 3.0]
    by_c = memory.explain(poses), memory.explain_newest(poses)
    assert memory._compiled is not None
    memory._compiled = None
    by_numpy = memory.explain(poses), memory.explain_newest(poses)
    for c, numpy in zip(by_c, by_numpy, strict=True):
        assert np.allclose(c, numpy, rtol=1e-4, atol=0.01)


def with_holes(skin: Layout) -> Layout:
    """Without every third taxel: columns have gaps, each elsewhere."""
    left = np.arange(len(skin)) % 3 > 0
    of_taxels = {name: getattr(skin, name)[left] for name in ("uid", "position_m", "normal")}
    return replace(skin, **of_taxels)


@needed
@pytest.mark.parametrize(
    "skin",
    [
        pytest.param(layouts.load(f"{RING},rows=1"), id="one ring"),
        pytest.param(layouts.load(f"{RING},rows=11"), id="columns higher than a vector"),
        pytest.param(with_holes(layouts.load(f"{RING},rows=11")), id="columns with gaps"),
        pytest.param(layouts.load("wrap:modules=12,radius_m=0.04,rows=2"), id="triangles"),
    ],
)
def test_c_and_numpy_explain_alike_however_taxels_stand(skin: Layout) -> None:
    """The object is another one at each height: who looks up the wrong taxel is found out."""
    scene = scene_of(box(0.03, 0.06), skin, symmetry=2)
    less_m = 0.001 * (np.arange(len(scene.heights), dtype=np.float32) % 4)
    scene = replace(scene, slices=scene.slices + less_m[:, None, None])
    memory = touched(ObservationModel(scene, skin, 0.005), Noise(), Slack(0.001, 0.001), 1)
    poses = np.random.default_rng(1).normal(size=(100, 3)) * [0.05, 0.05, 3.0]
    by_c = memory.explain(poses), memory.explain_newest(poses)
    memory._compiled = None
    by_numpy = memory.explain(poses), memory.explain_newest(poses)
    for c, numpy in zip(by_c, by_numpy, strict=True):
        assert np.ptp(numpy) > 1.0
        assert np.allclose(c, numpy, rtol=1e-4, atol=0.01)


@needed
@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**16), st.floats(0.0, 1.0), st.booleans())
def test_what_is_given_up_early_could_not_have_been_taken(
    box_model: ObservationModel, seed: int, least_share: float, has_prior: bool
) -> None:
    """And of all others every scan is told as without that."""
    memory, rng = (
        touched(box_model, Noise(), Slack(0.001, 0.001), seed),
        np.random.default_rng(seed),
    )
    poses = rng.normal(size=(60, 3)) * [0.05, 0.05, 1.0]
    if has_prior:
        metric, weight = PoseMetric(box_model.scene), np.full(60, 1.0 / 60)
        modes = metric.modes(poses, weight, 0.02, 5, 64)
        memory.prior = Prior(metric, poses, weight, modes)
    share = rng.uniform(least_share, 1.0, memory.terms)
    whole = memory.explain(poses)
    reached = whole @ share
    least = reached + rng.normal(size=60) * 20.0
    told = memory.explain(poses, Needed(share, least))
    taken = reached >= least
    assert np.array_equal(told[taken], whole[taken])
    assert (told[~taken] @ share < least[~taken]).all()


@needed
def test_most_that_could_not_be_taken_is_given_up_early(box_model: ObservationModel) -> None:
    memory = touched(box_model, Noise(), Slack(0.001, 0.001), 0)
    poses = np.random.default_rng(0).normal(size=(200, 3)) * [0.05, 0.05, 1.0]
    whole = memory.explain(poses)
    told = memory.explain(poses, Needed(memory.share, np.full(200, memory.ceiling.sum() - 10.0)))
    assert np.mean((told != whole).any(axis=1)) > 0.9


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


@needed
def test_a_session_ends_at_the_same_pose_with_and_without_c(tmp_path: Path) -> None:
    config = tmp_path / "config.toml"
    text = (SESSION / "config.toml").read_text(encoding="utf-8")
    config.write_text(f'{text}proposal = "table"\n', encoding="utf-8")
    command = [sys.executable, "-m", "taxeld.cli", "replay", str(SESSION), "--config", str(config)]
    last = []
    for switch in ("0", "1"):
        done = subprocess.run(
            command, capture_output=True, check=True, env=os.environ | {native.SWITCH: switch}
        )
        last.append(json.loads(done.stdout.splitlines()[-1]))
    assert last[0]["status"] == last[1]["status"]
    poses = [[end["map"][axis] for axis in ("x", "y", "theta")] for end in last]
    assert np.allclose(*poses, atol=[0.002, 0.002, 0.02])
