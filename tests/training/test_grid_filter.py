"""The grid filter: its belief is the exact one, and the truth stays in it."""

from dataclasses import replace

import numpy as np
import pytest

from taxeld.arrays import Poses
from taxeld.estimator.memory import Slack
from taxeld.model import contacts, se2, symmetry
from taxeld.model.noise import Noise
from taxeld.model.observation import Observation
from taxeld_training.limits import grid_cells
from taxeld_training.limits.grid_cells import Cells, tile
from taxeld_training.limits.grid_filter import DROP_NATS, GridFilter
from taxeld_training.limits.grid_likelihood import CellLikelihood, Evidence
from taxeld_training.limits.posterior import energy_distance
from taxeld_training.models.dataset import MIN_ACTIVATION

from ..rig.memories import memory_of, plus
from .rig import MODEL, SKIN

LIVE = np.ones(len(SKIN), dtype=bool)
NOISE = Noise()
SENSOR = np.array([0.3, -0.2, 1.0])
FAR = np.array([5.0, 0.0, 0.0])
BACK = np.array([1.1, 1.1, 1.0])  # times a pose that touches: the same, let go


def situation(seed: int) -> np.random.Generator:
    """Draws the same whatever TAXELD_TEST_SEED is: a reference by brute force is one of few
    situations."""
    return np.random.Generator(np.random.PCG64(seed))


def band(n: int, rng: np.random.Generator) -> Poses:
    """`n` poses in the sensor frame, uniform over those that press the skin."""
    low, high = MODEL.scene.extent
    poses = np.empty((0, 3))
    while len(poses) < n:
        ax, ay = rng.uniform(low[:, None], high[:, None], (2, 10 * n))
        theta = rng.uniform(-np.pi, np.pi, 10 * n)
        drawn = contacts.pose_of_axis(ax, ay, theta)
        gap = contacts.clearance(MODEL.scene, SKIN.radius_m, drawn)
        poses = np.concatenate([poses, drawn[(gap < 0.0) & (gap > -MODEL.depth_max_m)]])
    return poses[:n]


def contact_poses(n: int, rng: np.random.Generator) -> Poses:
    """`n` of those at which a taxel reads enough to be simulated."""
    poses = band(3 * n, rng)
    return poses[MODEL.activation(poses).max(axis=1) > MIN_ACTIVATION][:n]


def drawn(belief: GridFilter, n: int) -> Poses:
    """`n` poses evenly through the belief: less noise than chance has."""
    return belief.pose[np.searchsorted(belief.weight.cumsum(), (np.arange(n) + 0.5) / n)]


def test_the_first_cells_tile_all_contacts_once() -> None:
    """Cells' midpoints have the volume and the reach of poses drawn evenly."""
    cells = tile(MODEL)
    low, high = MODEL.scene.extent
    axis = situation(0).uniform(low, high, (200_000, 2))
    gap = MODEL.scene.clearance(*axis.T)[0] - SKIN.radius_m
    pressed = (gap < 0.0) & (gap > -MODEL.depth_max_m)
    area = pressed.mean() * np.prod(high - low)
    volume = np.exp(cells.log_effective_volume).sum()
    assert volume == pytest.approx(2.0 * np.pi * area, rel=0.02)
    half = 0.5 * np.hypot(grid_cells.FIRST_M, grid_cells.FIRST_DEEP_M)
    middle = np.unique(cells.mid[:, :2], axis=0)
    away = np.linalg.norm(axis[pressed][:300, None] - middle, axis=-1).min(axis=1)
    assert away.max() < 1.3 * half


@pytest.mark.parametrize("scale", [0.0, 1.0])
def test_a_small_cell_has_the_likelihood_of_the_filters_memory(scale: float) -> None:
    """Offsets that grow with the contacts since, residues, floors, and a contact of two scans that
    counts as one; silence behind a contact."""
    rng = situation(8)
    poses = contact_poses(200, rng)
    slack = Slack(0.002, 0.001, scale)
    known, evidence = memory_of(MODEL, NOISE, slack), []
    half = np.arange(len(SKIN)) % 2 > 0
    floor, residue = np.where(half, 0.2, 0.01), np.where(half, 0.1, 0.0)
    beside = (se2.IDENTITY, np.array([0.002, 0.003, 0.1]), np.array([-0.004, 0.002, -0.2]))
    for share, contact, step in zip((0.5, 0.5, 1.0), (1, 1, 2), beside, strict=True):
        sensor = se2.compose(SENSOR, step)
        seen = se2.compose(se2.inverse(sensor), se2.compose(SENSOR, poses[:1]))
        z = NOISE.draw(MODEL.activation(seen)[0], rng)
        live = rng.random(len(SKIN)) < 0.8
        scan = Observation(sensor, np.where(z < floor, 0.0, z), live, floor, residue)
        known = plus(known, scan, contact)
        variance = float(slack.variance(np.array(2 - contact)))
        evidence.append(Evidence(scan, share, variance, touched=True))
    silent = Observation(se2.compose(SENSOR, beside[1]), np.zeros(len(SKIN)), LIVE, floor, residue)
    known = plus(known, silent, 2)
    evidence.append(Evidence(silent, 1.0, float(slack.variance(np.array(0))), touched=False))
    ax, ay = contacts.axis_in_object(poses)
    mid = np.column_stack([ax, ay, poses[:, 2]])
    cells = Cells.unweighed(mid, np.tile(1e-8 * np.eye(3), (200, 1, 1)), np.zeros(200))
    CellLikelihood(MODEL, NOISE).add(cells, evidence, SENSOR)
    expected = known.explain(se2.compose(SENSOR, poses)) @ [0.5, 0.5, 1.0, 1.0]
    # but for poses at which a taxel that reads is just at the end of the band
    assert np.quantile(np.abs(cells.log_likelihood - expected), 0.98) < 0.002
    assert np.quantile(np.abs(cells.log_likelihood_max - expected), 0.98) < 0.002
    assert cells.information.max() < 1e-3


def test_no_pose_explains_more_than_the_best_of_its_cell() -> None:
    """Or cells would be dropped that hold the truth: a touch, and silence beside another."""
    rng = situation(6)
    first, second = contact_poses(2, rng)
    beside = se2.compose(first, se2.inverse(second * BACK))
    z = NOISE.draw(MODEL.activation(first[None])[0], rng)
    scans = [Observation(np.zeros(3), z, LIVE), Observation(beside, np.zeros(len(SKIN)), LIVE)]
    likelihood, known = CellLikelihood(MODEL, NOISE), memory_of(MODEL, NOISE)
    for scan in scans:
        known = plus(known, scan)
    cells = tile(MODEL)
    for _ in range(6):
        cells = cells[rng.random(len(cells)) < 2000 / len(cells)]
        likelihood.add(cells, [Evidence(scan) for scan in scans], np.zeros(3))
        within = rng.uniform(-0.5, 0.5, (8, len(cells), 1, 3)) @ cells.edge
        poses = contacts.pose_of_axis(*(cells.mid + within[:, :, 0]).reshape(-1, 3).T)
        explained = known.explain(poses).sum(axis=1).reshape(8, -1).max(axis=0)
        matter = explained > explained.max() - DROP_NATS
        assert np.quantile((explained - cells.log_likelihood_max)[matter], 0.99) < 1.0
        cells = cells.halved()


def test_the_truth_stays_in_the_belief_and_the_estimate_reaches_it() -> None:
    rng, truth = situation(0), np.array([0.1, 0.2, 2.0])
    belief = GridFilter(MODEL, NOISE, Slack())
    belief.update(Observation(FAR, NOISE.draw(np.zeros(len(SKIN)), rng), LIVE), 0, touched=False)
    assert len(belief) == len(belief.pose) == len(belief.weight) == 0
    for number, pose in enumerate(contact_poses(6, rng), 1):
        z = NOISE.draw(MODEL.activation(pose[None])[0], rng)
        sensor = se2.compose(truth, se2.inverse(pose))
        belief.update(Observation(sensor, z, LIVE), number, touched=True)
        assert belief.metric.distance(belief.pose, truth).min() < 0.003
    assert symmetry.add_m(MODEL.scene, belief.estimate(), truth)[1] < 0.002


def gaps(number: int) -> list[float]:
    """The distances of a grid's belief to poses drawn by chance and weighed by the daemon's memory,
    the last four with something unsaid. A silent scan beside a face, two scans of one contact and
    one of another, the sensor reported 3 mm off throughout each contact."""
    noise, sd_m = Noise(sigma=0.1, gain_cv=0.3, outliers=0.05), 0.003
    rng = situation(number)
    first, other = contact_poses(2, rng)
    slid = se2.compose(np.array([0.0, 0.0, 0.15]), first)
    floor = np.where(np.arange(len(SKIN)) % 2 > 0, 0.3, 0.02)
    scans = []
    for contact, pose in ((1, first), (1, slid), (2, other)):
        z = noise.draw(MODEL.activation(pose[None])[0], rng)
        error = sd_m * np.array([*situation(contact).standard_normal(2), 0.0])
        sensor = se2.compose(SENSOR, se2.inverse(pose)) + error
        scan = Observation(sensor, np.where(z < floor, 0.0, z), LIVE, floor, 0.2)
        scans.append((contact, scan))
    x, y = first[:2]
    beside = se2.compose(scans[0][1].sensor, np.array([0.3 * x - y, 0.3 * y + x, 0.0]))
    scans.insert(0, (0, replace(scans[0][1], sensor=beside, z=np.zeros(len(SKIN)))))
    known = memory_of(MODEL, noise, Slack(sd_m))
    for contact, scan in scans:
        known = plus(known, scan, contact)
    # all poses at the strongest touch, less those that are out of the question
    low, high = MODEL.scene.extent
    ax, ay = rng.uniform(low[:, None], high[:, None], (2, 480_000))
    poses = contacts.pose_of_axis(ax, ay, rng.uniform(-np.pi, np.pi, len(ax)))
    gap = contacts.clearance(MODEL.scene, SKIN.radius_m, poses)
    poses = poses[(gap < 3.0 * sd_m) & (gap > -MODEL.depth_max_m - 3.0 * sd_m)]
    strongest = max((scan for _, scan in scans), key=lambda scan: scan.z.sum())
    poses = se2.compose(strongest.sensor, poses)
    log_w = np.concatenate([known.explain(some) for some in np.array_split(poses, 8)]) @ known.share
    w = np.exp(log_w - log_w.max())
    exact = poses[rng.choice(len(w), 800, p=w / w.sum())]

    def gap_of(
        slack_m: float = sd_m, residues: bool = True, shared: bool = True, silent: bool = True
    ) -> float:
        grid = GridFilter(MODEL, noise, Slack(slack_m))
        for k, (contact, scan) in enumerate(scans):
            given = scan if residues else replace(scan, residue=0.0)
            if k or silent:
                grid.update(given, contact if shared else k, touched=k > 0)
        return energy_distance(drawn(grid, 800), exact, 0.05)

    unsaid = {"slack_m": 0.0}, {"residues": False}, {"shared": False}, {"silent": False}
    return [gap_of(), *(gap_of(**each) for each in unsaid)]


@pytest.mark.check
def test_the_belief_is_that_of_brute_force_and_all_of_a_scan_counts() -> None:
    gap, *others = np.sum([gaps(7), gaps(11)], axis=0)
    assert gap < min(0.02, min(others) / 3.0)
