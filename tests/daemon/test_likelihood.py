"""How well poses explain scans that are a little off, that the C code does as numpy does, and
what readings are worth without the object."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from taxeld import native
from taxeld.arrays import Floats, Poses
from taxeld.estimator.background import Background
from taxeld.estimator.likelihood import NumpyExplainer
from taxeld.estimator.memory import Memory, ObjectSkin, OffsetVariance
from taxeld.layout.layout import Layout
from taxeld.model import contacts, se2
from taxeld.model.noise import Noise
from taxeld.model.observation import BAND_M, Observation, ObservationModel
from taxeld.model.response import LEAST_RATE, SAG_M, SAG_SD, sagging
from taxeld.proposals import bundle
from tests.rig.memories import memory_of, plus
from tests.rig.pressed_box import box_side
from tests.rig.scenes import DEPTH_MAX_M, box, scene_of
from tests.rig.skins import SKIN

SD_M = 0.001
NOISE = Noise(sigma=0.04, gain_cv=0.17)
EXPLAIN = "estimator/explain"
needed = pytest.mark.skipif(
    native.library(EXPLAIN) is None, reason="taxeld was installed without a C compiler"
)


def presses(model: ObservationModel, n: int) -> Poses:
    """(n, 3) of the object in the sensor's frame; each presses well."""
    made = contacts.synthesise(model.scene, 0.04, 0.005, 40 * n, np.random.default_rng(0)).pose
    return made[model.activation(made).max(axis=1) > 0.4][:n]


def felt(model: ObservationModel, press: Poses) -> Observation:
    """The object at the origin."""
    z = model.activation(press[None])[0]
    return Observation(se2.inverse(press), np.where(z < 0.01, 0.0, z), z >= 0.0)


SOFT = replace(NOISE, sag_m=SAG_M, sag_sd=SAG_SD)
SILENT = replace(SOFT, answers=0.5)


def beside_monte_carlo(model: ObservationModel, noise: Noise, sd_m: float, seed: int) -> Floats:
    """(20, 2) nats by which the likelihood of touches at the truth, as it is used and by numpy, is
    over the mean of the exact one at many offsets. Readings err as the estimator believes."""
    rng, skin = np.random.default_rng((seed, 48)), ObjectSkin.of(model, noise)
    by_numpy = replace(skin, explainers=[NumpyExplainer(model, noise)])
    made = contacts.synthesise(model.scene, model.layout.radius_m, DEPTH_MAX_M, 800, rng).pose
    poses, off = np.zeros((5000, 3)), []
    poses[:, :2] = sd_m * np.random.default_rng(seed).standard_normal((5000, 2))
    for sensor in se2.inverse(made[model.activation(made).max(axis=1) > 0.1][:20]):
        near, h = model.near(sensor[None], np.full(1, BAND_M)), np.zeros(len(model.layout))
        rate = near.along * SAG_M * np.exp(SAG_SD * rng.standard_normal(len(near.along)))
        h[near.taxel] = np.clip(sagging(near.depth, np.maximum(rate, LEAST_RATE)), 0.0, 1.0)
        told = sensor + sd_m * np.array([*rng.standard_normal(2), 0.0])
        scan = Observation(told, noise.draw(h, rng), np.ones(len(h), dtype=np.bool_))
        exact = plus(Memory(skin), scan, 1).explain(poses).scans
        found = [plus(Memory(each, OffsetVariance(sd_m)), scan, 1) for each in (skin, by_numpy)]
        mean = np.log(np.exp(exact - exact.max()).mean()) + exact.max()
        off.append([each.explain(np.zeros((1, 3))).scans[0, 0] - mean for each in found])
    return np.array(off)


@pytest.mark.parametrize(
    ("noise", "sd_m", "nats"),
    [(SOFT, 0.001, 0.5), (SOFT, 0.002, 0.5), (SOFT, 0.005, 1.5), (SILENT, 0.002, 0.5)],
)
def test_the_likelihood_is_the_integral_over_all_offsets(
    noise: Noise, sd_m: float, nats: float
) -> None:
    """Of nine touches in ten, which 200 tell to within 6 of a hundred."""
    models = [bundle.load(name, SKIN, DEPTH_MAX_M).model for name in ("box", "mug")]
    off = [beside_monte_carlo(each, noise, sd_m, seed) for each in models for seed in range(5)]
    assert ((np.abs(np.concatenate(off)) < nats).mean(axis=0) > 0.84).all()


def test_a_place_that_is_known_badly_is_a_scans_own_slack(box_model: ObservationModel) -> None:
    """A touch's and a silent one's."""
    none, offsets = (
        memory_of(box_model, NOISE),
        memory_of(box_model, NOISE, OffsetVariance(3.0 * SD_M)),
    )
    poses = 0.004 * np.random.default_rng(0).standard_normal((20, 3))
    scans = [felt(box_model, press) for press in presses(box_model, 3)]
    scans.append(replace(scans[0], z=np.zeros(len(scans[0].z))))
    for scan in scans:
        vague = plus(none, replace(scan, place_sd_m=3.0 * SD_M))
        assert np.allclose(vague.explain(poses).scans, plus(offsets, scan).explain(poses).scans)
        assert not np.allclose(vague.explain(poses).scans, plus(none, scan).explain(poses).scans)


def test_an_old_touch_fades_by_what_has_happened_since(box_model: ObservationModel) -> None:
    """An object that gives way at each touch: the same reading says less of where it is now."""
    press = se2.inverse(box_side(box_model, 0.2, 0.003))
    memory = plus(memory_of(box_model, NOISE, OffsetVariance(0.0, SD_M)), felt(box_model, press), 1)
    poses = np.linspace(-0.004, 0.004, 9)[:, None] * np.eye(3)[0]
    spread = [np.ptp(replace(memory, newest=newest).explain(poses).scans) for newest in (1, 3, 9)]
    assert spread[0] > 1.5 * spread[1] > 1.5 * 1.2 * spread[2]


def touched(model: ObservationModel, noise: Noise, offsets: OffsetVariance) -> Memory:
    """Scans of presses and silent ones, dead taxels, floors and residues among them."""
    rng, memory = np.random.default_rng(0), memory_of(model, noise, offsets)
    for number in range(1, 9):
        sensor = rng.normal(size=3) * [0.05, 0.05, 1.0]
        made = contacts.synthesise(model.scene, 0.04, model.depth_max_m, 20, rng)
        seen = made.pose[:1]  # some of the twenty miss the object
        z = noise.draw(model.activation(seen)[0], rng) * (rng.random() < 0.7)
        floor = np.where(rng.random(len(z)) < 0.2, 0.1, 0.02)
        live = rng.random(len(z)) < 0.9
        residue = 0.1 * rng.random(len(z))
        z = np.where(live & (z >= floor), z, 0.0)
        memory = plus(memory, Observation(sensor, z, live, floor, residue), number)
    return memory


def test_poses_that_are_none_and_no_poses_are_explained_by_something(
    box_model: ObservationModel,
) -> None:
    memory = touched(box_model, Noise(), OffsetVariance(0.001, 0.001))
    for value in (np.nan, np.inf, -np.inf, 1e300):
        if native.library(EXPLAIN):
            assert memory.explain(np.full((1, 3), value)).scans.shape == (1, 8)
            assert memory.explain(np.diag([value] * 3)).scans.shape == (3, 8)
    assert memory.explain(np.empty((0, 3))).scans.shape == (0, 8)
    assert memory_of(box_model, Noise()).explain(np.zeros((4, 3))).scans.shape == (4, 0)


LEAST, MOST = np.array([[0.02, 0.05, 0.0, 0.1, 0.0], [0.05, 0.2, 0.005, 1.0, 1.0]])[:, :, None]
UNEVEN = np.random.default_rng(7).uniform(LEAST, MOST, (5, 32))  # of a ring's taxels


@needed
@pytest.mark.parametrize(
    "offsets", [OffsetVariance(), OffsetVariance(0.001, 0.001), OffsetVariance(0.005)]
)
@pytest.mark.parametrize(
    "noise",
    [Noise(), Noise(0.04, sag_m=0.002, sag_sd=0.9), Noise(*UNEVEN[:2], 0.01, *UNEVEN[2:])],
    ids=["no sag", "sag", "each taxel its own"],
)
def test_c_explains_what_numpy_explains(
    box_model: ObservationModel,
    monkeypatch: pytest.MonkeyPatch,
    noise: Noise,
    offsets: OffsetVariance,
) -> None:
    poses = np.random.default_rng(1).normal(size=(400, 3)) * [0.06, 0.06, 2.0]
    by_c = touched(box_model, noise, offsets).explain(poses).scans
    monkeypatch.setenv(native.SWITCH, "0")
    native.library.cache_clear()
    by_numpy = touched(box_model, noise, offsets).explain(poses).scans
    native.library.cache_clear()
    assert (by_c != by_numpy).any()
    apart = ~np.isclose(by_c, by_numpy, atol=0.01)
    assert apart.mean() < 5e-3  # rounding decides whether a taxel is at the edge of a press


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


QUIET_NOISE = Noise(sigma=0.04)
AT = np.zeros((1, 3))  # where the object is


def touches(model: ObservationModel, n: int) -> list[Observation]:
    """Firm presses of the object, that a noisy skin reads."""
    rng = np.random.default_rng(0)
    made = contacts.synthesise(model.scene, 0.04, DEPTH_MAX_M, 40 * n, rng).pose
    firm: Poses = made[model.activation(made).max(axis=1) > 0.4][:n]
    return [
        Observation(
            se2.inverse(pose),
            QUIET_NOISE.draw(model.activation(pose[None])[0], rng),
            np.ones(len(model.layout), np.bool_),
        )
        for pose in firm
    ]


def ahead(model: ObservationModel, scan: Observation) -> float:
    """Nats by which the object where it is explains a scan better than anything."""
    known = plus(memory_of(model, QUIET_NOISE), scan)
    return float(known.explain(AT).scans[0, 0] - known.background[0])


def test_the_object_explains_its_contacts_better_than_anything_but_no_disorder(
    box_model: ObservationModel,
) -> None:
    scans, rng = touches(box_model, 40), np.random.default_rng(1)
    gains = [ahead(box_model, scan) for scan in scans]
    assert np.median(gains) > 4.0
    assert np.mean(np.array(gains) > 0.0) > 0.9
    mixed = [replace(scan, z=rng.permutation(scan.z)) for scan in scans]
    assert np.median([ahead(box_model, scan) for scan in mixed]) < -10.0


def test_readings_are_no_likelier_in_all_than_they_can_be(box_model: ObservationModel) -> None:
    """The mean ratio of two densities, over draws of the one below, is at most 1: also of ratios
    cut at 10, whose mean few draws tell."""
    background, rng = Background(box_model, QUIET_NOISE), np.random.default_rng(2)
    for scan in touches(box_model, 5):
        h = box_model.activation(se2.inverse(scan.sensor)[None])[0]
        ratios = []
        for _ in range(100):
            z = QUIET_NOISE.draw(h, rng)
            log_p = float(QUIET_NOISE.log_density(z, h).sum())
            ratios.append(np.exp(background.log_density(replace(scan, z=z)) - log_p))
        assert np.minimum(ratios, 10.0).mean() < 1.0


def test_what_is_felt_all_round_the_skin_is_alike(box_model: ObservationModel) -> None:
    """The shapes are the same about whatever side is touched, and the ring has 16 of them."""
    background, layout = Background(box_model, QUIET_NOISE), box_model.layout
    for scan in touches(box_model, 10):
        turned = [background.log_density(replace(scan, z=scan.z[turn])) for turn in layout.turns]
        assert np.ptp(turned) < 0.01


def test_a_skin_on_half_of_the_link_is_touched_from_half_as_many_sides() -> None:
    angle = np.radians(np.arange(-85.0, 90.0, 10.0))
    normal = np.stack([np.cos(angle), np.sin(angle), np.zeros(18)], axis=1)
    skin = Layout("half", np.arange(1, 19), 0.04 * normal, normal, 0.04)
    model = ObservationModel(scene_of(box(0.03, 0.06), skin, symmetry=2), skin, DEPTH_MAX_M)
    gains = [ahead(model, scan) for scan in touches(model, 20)]
    assert np.isfinite(gains).all()
    assert np.median(gains) > 2.0
