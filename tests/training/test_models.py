"""Models: their coordinates and views mean what they say, every one learns the posterior, and its
ONNX file gives what torch gives."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import pytest
import torch
from torch import Tensor

from taxeld.arrays import Floats, Poses
from taxeld.model import contacts, se2
from taxeld.model.noise import FLOOR, Noise
from taxeld.model.observation import ObservationModel
from taxeld.proposals.analytic import Projection
from taxeld.proposals.sampler import Sampler
from taxeld_training.limits import quality
from taxeld_training.limits.dense import Dense
from taxeld_training.limits.posterior import ExactPosterior, energy_distance
from taxeld_training.models import variants
from taxeld_training.models.base import NetworkConfig
from taxeld_training.models.dataset import (
    FLOOR_MAX,
    MIN_ACTIVATION,
    Batches,
    SimulatedTouches,
    read,
    simulate,
)
from taxeld_training.models.density import BINS, ContactDensity
from taxeld_training.models.diffusion import Denoiser, DiffusionSampler
from taxeld_training.models.export import export, rounded
from taxeld_training.models.frames import ContactFrame, PoseFrame, rotated
from taxeld_training.models.variants import Variant
from taxeld_training.models.views import Centred, Plain, Turned, best

from .rig import HALF, HALF_SKIN, MODEL, SKIN, TOUCHES

TRAINING = variants.density(8).training
FEW = NetworkConfig(8, 16, steps=8)  # T: the unrolled graph of a hundred is slow to export
SMALL = {
    "density": variants.density(8, encoder_width=16),
    "ddpm": Variant("diffusion", FEW, TRAINING),
    "paper": Variant("diffusion", FEW, TRAINING, "plain", "pose"),
}


def fitted(
    variant: Variant, model: ObservationModel, touches: SimulatedTouches, updates: int
) -> torch.nn.Module:
    small = variants.trained_with(variant, updates / variant.training.updates, 20_000, 0)
    return variants.sampler_of(variants.fit(small, model, Noise(), touches))


@pytest.mark.parametrize(
    ("name", "model"), [("density", MODEL), ("density", HALF), ("ddpm", MODEL), ("paper", HALF)]
)
def test_onnx_equals_torch(name: str, model: ObservationModel, tmp_path: Path) -> None:
    """For any number of samples."""
    taxels = len(model.layout)
    some = simulate(model, 2000, np.random.default_rng(0))
    sampler = fitted(SMALL[name], model, some, 3)
    path = tmp_path / "s.onnx"
    export(sampler, taxels, path, {"training": {"seed": 1}})  # type: ignore[arg-type]
    session = ort.InferenceSession(path, providers=["CPUExecutionProvider"])
    for i, samples in enumerate((1, 3, 250)):
        z = torch.from_numpy(some.activation[i : i + 1])
        live = (torch.rand(1, taxels) > 0.2).float()
        noise = torch.randn(sampler.steps, samples, 4)  # type: ignore[call-overload]
        with torch.no_grad():
            expected = rounded(sampler)(z, live, noise).numpy()  # type: ignore[arg-type]
        inputs = {"z": z.numpy(), "live": live.numpy(), "noise": noise.numpy()}
        assert np.quantile(np.abs(session.run(None, inputs)[0] - expected), 0.98) < 1e-3
    metadata = {p.key: json.loads(p.value) for p in onnx.load(path).metadata_props}
    assert metadata == {"training": {"seed": 1}}


def test_a_trained_model_is_near_the_posterior(tmp_path: Path) -> None:
    to = quality.reference(MODEL, Noise(), 20, np.random.default_rng(1), bank=40_000)
    sampler = fitted(variants.density(32), MODEL, TOUCHES, 300)
    export(sampler, len(SKIN), tmp_path / "s.onnx", {})  # type: ignore[arg-type]
    rng = np.random.default_rng(2)
    learned = Sampler((tmp_path / "s.onnx").read_bytes(), SKIN, "density", tmp_path)
    uninformed = quality.distances(Projection(MODEL), to, rng).mean()
    assert quality.distances(learned, to, rng).mean() < 0.12 * uninformed


def test_the_density_integrates_to_one() -> None:
    torch.manual_seed(0)
    net = ContactDensity(NetworkConfig(8, 16), best(SKIN), ContactFrame(MODEL)).eval()
    net.scale.copy_(torch.tensor([0.1, 0.001]))
    side, half = 49, 12.0
    at = torch.linspace(-half, half, side)
    s, phi, depth = torch.meshgrid((torch.arange(BINS) + 0.5) / BINS, at, at, indexing="ij")
    z, live = torch.zeros(1, 32), torch.ones(1, 32)
    z[0, 5] = 0.7
    with torch.no_grad():
        seen, angle = net.view(z, live)
        grid = torch.stack([s, 0.1 * phi + angle, 0.001 * depth], dim=-1).reshape(-1, 3)
        n = len(grid)
        log_each = net.log_density(seen.expand(n, -1), angle.expand(n), grid)
    cell = (2 * half / (side - 1)) ** 2
    # the Gaussians' constant, which training does not need
    assert float(log_each.exp().sum()) * cell / (2 * np.pi) == pytest.approx(1.0, abs=0.02)


class GaussianDenoiser(Denoiser):
    """The exact v of data N(0.5, 0.3²): E[ε|x] and E[x₀|x] are linear in x."""

    def run(self, x: Tensor, shift: Tensor) -> Tensor:
        a = self.alpha_bar[int(shift[0, 0].item())]
        variance = a * 0.3**2 + 1.0 - a
        clean = 0.5 + a.sqrt() * 0.3**2 / variance * (x - a.sqrt() * 0.5)
        noise = (x - a.sqrt() * clean) / (1.0 - a).sqrt()
        return a.sqrt() * noise - (1.0 - a).sqrt() * clean


def test_the_diffusion_draws_the_gaussian_of_its_denoiser() -> None:
    net = GaussianDenoiser(NetworkConfig(steps=100, width=4), Plain(SKIN), PoseFrame())
    with torch.no_grad():
        net.time.weight.copy_(torch.arange(100)[:, None].expand(-1, 12))
        net.context.weight.zero_()
        net.context.bias.zero_()
        sampler = DiffusionSampler(net)
        noise = torch.randn(100, 20_000, 4, generator=torch.Generator().manual_seed(0))
        drawn = sampler(torch.zeros(1, 32), torch.ones(1, 32), noise)
    assert torch.allclose(drawn.mean(0), torch.full((4,), 0.5), atol=0.01)
    assert torch.allclose(drawn.std(0), torch.full((4,), 0.3), atol=0.02)


def of_four(four: Tensor) -> Poses:
    x, y, c, s = four.double().numpy().T
    return np.column_stack([x, y, np.arctan2(s, c)])


def worst_mm(a: Poses, b: Poses) -> float:
    return 1e3 * float(np.hypot(*(a - b)[:, :2].T).max())


@pytest.mark.parametrize("frame", [ContactFrame(MODEL), PoseFrame()])
def test_a_pose_is_recovered_and_turns_with_its_coordinates(
    frame: ContactFrame | PoseFrame,
) -> None:
    coordinates = frame.encode(TOUCHES.pose)
    back = of_four(frame.decode(frame.features(coordinates)))
    assert worst_mm(back, TOUCHES.pose) < 0.5
    assert np.abs(np.sin(back[:, 2] - TOUCHES.pose[:, 2])).max() < 0.02
    angle = torch.linspace(-3.0, 3.0, len(TOUCHES))
    turned = frame.features(frame.turned(coordinates, angle))
    assert worst_mm(of_four(rotated(frame.decode(turned), angle)), TOUCHES.pose) < 0.5


def test_depth_and_direction_are_how_deep_and_where_the_skin_is_pressed() -> None:
    frame, s = ContactFrame(MODEL), torch.linspace(0.0, 1.0, 400)
    made = of_four(frame.pose(s, 6.0 * s - 3.0, torch.full_like(s, 0.003)))
    gap = contacts.clearance(MODEL.scene, SKIN.radius_m, made)
    assert np.abs(gap + 0.003).max() < 2e-4
    x, y, _ = SKIN.position_m[TOUCHES.activation.argmax(axis=1)].T
    off = np.angle(np.exp(1j * (np.arctan2(y, x) - frame.encode(TOUCHES.pose)[:, 1].numpy())))
    assert np.quantile(np.abs(off), 0.99) < 2.0 * np.pi / 16


def seen_by(
    view: Plain | Turned | Centred, model: ObservationModel, pose: Poses, turn: float
) -> tuple[Tensor, Tensor]:
    """A view of touches (n, 3), with the sensor turned about its axis."""
    h = torch.from_numpy(model.activation(se2.compose(np.array([0.0, 0.0, turn]), pose))).float()
    seen: tuple[Tensor, Tensor] = view(h, torch.ones_like(h))
    return seen


def test_a_ring_sees_the_same_touch_at_every_column() -> None:
    view, turn = Turned(SKIN), 2.0 * np.pi * 5 / 16
    here, angle = seen_by(view, MODEL, TOUCHES.pose[:200], 0.0)
    there, other = seen_by(view, MODEL, TOUCHES.pose[:200], turn)
    same = (here - there).abs().amax(dim=1) < 1e-3
    assert same.float().mean() > 0.95  # two columns may feel the same, and rounding choose
    gap = torch.remainder(other - angle, 2 * np.pi)[same]
    assert torch.allclose(gap, torch.full_like(gap, turn), atol=1e-4)


def test_a_skin_without_symmetry_sees_nearly_the_same_touch_from_every_side() -> None:
    """As the taxels lie unevenly, the window is compared by where its weight is."""
    view = best(HALF_SKIN)
    centres = []
    for turn in (-0.6, -0.2, 0.3, 0.7):
        seen, angle = seen_by(view, HALF, np.array([[0.068, 0.0, 0.0]]), turn)
        grid = seen[0, : view.width // 3].reshape(-1, view.rows).sum(dim=1)
        cells = torch.arange(-view.reach, view.reach + 1)
        offset = (grid * cells).sum() / grid.sum() / view.cells_per_rad
        centres.append(float(angle[0] + offset) - turn)
    assert np.ptp(centres) < 0.15


@pytest.mark.parametrize("kind", [Plain, Turned, Centred])
def test_no_dead_taxel_is_seen_and_a_batch_as_each_of_its_touches(kind: type) -> None:
    """A batch goes by the few taxels that are pressed or dead, a touch by all of them."""
    view, rng = kind(HALF_SKIN), np.random.default_rng(0)
    z = torch.from_numpy(simulate(HALF, 50, rng).activation)
    live = torch.from_numpy(rng.random(z.shape) > 0.2).float()
    live[:10] = 1.0
    together, angles = view(z, live)
    other = view(torch.where(live > 0.0, z, 1.0), live)
    assert all(torch.equal(*both) for both in zip((together, angles), other, strict=True))
    for k in range(50):
        alone, angle = view(z[k : k + 1], live[k : k + 1])
        assert torch.equal(angle, angles[k : k + 1])
        assert torch.allclose(alone[0], together[k], atol=1e-3)  # of a root, for rounding's sake


NOISE = Noise()
DRAWS = 1000


def drawn(noise: Noise, n: int) -> list[Floats]:
    """z, live and pose of `n` readings that training meets."""
    coordinates = PoseFrame().encode(TOUCHES.pose)
    batches = Batches(TOUCHES, coordinates, MODEL.leak, noise, 1, torch.device("cpu"))
    return [part.double().numpy() for part in batches.draw(n)]


def test_training_meets_readings_of_poses_that_press_a_taxel() -> None:
    """Up to what presses beside a taxel may leave in it."""
    assert (TOUCHES.activation.max(axis=1) > MIN_ACTIVATION).all()
    z, live, pose = drawn(Noise(sigma=0.0, gain_cv=0.0), 500)
    expected = MODEL.activation(pose) * live
    felt = z > 0.0
    assert (np.abs(z - expected) < 1e-3 + 6.0 * MODEL.leak.drawn(expected))[felt].all()
    assert (expected < 0.4)[~felt].mean() > 0.999
    assert 0.01 < (live == 0).mean() < 0.2


def test_training_meets_floors_of_any_height_and_presses_that_are_read_beside_them() -> None:
    """What is learned holds for all skins of the trials, and for one that sags and couples. But
    nothing is met that presses beside a taxel may explain."""
    z, _, pose = drawn(NOISE, 3000)
    least = np.where(z > 0.0, z, np.inf).min(axis=1)
    assert (least >= FLOOR).all()
    assert 0.3 < np.mean(least > 0.5 * FLOOR_MAX) < 1.0  # of an unthresholded skin hardly any
    assert (z.max(axis=1) > 0.0).mean() > 0.99
    # more than noise, which is never felt on its own
    assert 0.005 < np.mean((z > 0.0) & (MODEL.activation(pose) == 0.0)) < 0.1
    for each in (z, read(MODEL, NOISE, 500, np.random.default_rng(0)).z):
        assert (each[each > 0.0] >= MODEL.leak.of(each)[each > 0.0]).all()


def test_readings_are_as_a_filter_sees_them() -> None:
    seen = read(MODEL, NOISE, 500, np.random.default_rng(0), dead=0.3)
    assert len(seen.z) == len(list(seen)) == 500
    assert ((seen.z == 0.0) | (seen.z >= seen.floor)).all()
    assert (seen.floor >= FLOOR).all()
    assert (seen.floor >= seen.residue).all()  # what presses beside a taxel leave is under it
    assert np.ptp(seen.floor.min(axis=1)) > 0.05  # skins differ
    assert seen.z.any(axis=1).all()  # each is felt
    assert (seen.z[~seen.live] == 0.0).all()
    assert np.mean(~seen.live) == pytest.approx(0.3, abs=0.02)


def test_the_exact_posterior_is_that_of_the_daemons_likelihood() -> None:
    """Against importance weights over the same bank with every turn tried, and no shortcut."""
    rng = np.random.default_rng(0)
    bank = simulate(MODEL, 4000, rng)
    posterior = ExactPosterior(bank, SKIN, NOISE)
    back = np.zeros((len(SKIN.turns), 3))
    back[:, 2] = -2.0 * np.pi * np.arange(len(SKIN.turns)) / len(SKIN.turns)
    poses = np.concatenate([se2.compose(turn, bank.pose) for turn in back])
    told = []
    for seen in read(MODEL, NOISE, 6, rng):
        log_w = np.concatenate(
            [
                NOISE.log_density(
                    seen.z, bank.activation[:, turn].astype(float), seen.floor, seen.residue
                ).sum(axis=1)
                for turn in SKIN.turns
            ]
        )
        w = np.exp(log_w - log_w.max())
        pick = rng.choice(len(w), 2000, p=w / w.sum())
        ess = w.sum() ** 2 / (w**2).sum()
        # floors and residues count: without them it is another posterior
        variants = seen, replace(seen, floor=FLOOR), replace(seen, residue=0.0)
        found = [posterior.sample(one, 2000, rng) for one in variants]
        assert energy_distance(found[0].pose, poses[pick], 0.05) < 0.01
        told.append(np.isclose([draws.ess for draws in found], ess, rtol=0.05))
    assert np.all(told, axis=0).tolist() == [True, False, False]


@pytest.mark.parametrize("shift", [0.0, 1.5])
def test_the_distance_of_two_normal_distributions_is_that_of_the_closed_form(shift: float) -> None:
    """E|N(m, v)| = √(2v/π) exp(−m²/2v) + m erf(m/√(2v)) in one dimension, here of v = 2. Of few
    samples it is right on average, so that of one distribution it is now and then below 0."""
    rng = np.random.default_rng(0)
    samples = np.zeros((500, 2, 30, 3))
    samples[..., 0] = rng.standard_normal(samples.shape[:-1])
    samples[:, 1, :, 0] += shift
    found = np.array([energy_distance(a, b, 1.0) for a, b in samples])
    apart = [
        2.0 / np.sqrt(np.pi) * np.exp(-(m**2) / 4.0) + m * math.erf(m / 2.0) for m in (shift, 0.0)
    ]
    expected = 2.0 * (apart[0] - apart[1])
    assert abs(found.mean() - expected) < 3.0 * found.std() / np.sqrt(len(found))
    assert (found < 0.0).any() == (shift == 0.0)


@pytest.mark.check
def test_contacts_made_around_a_reading_have_the_posterior_of_a_large_bank() -> None:
    """A hundredth of the contacts is enough to begin with."""
    rng = np.random.default_rng(1)
    thin, full = (
        ExactPosterior(simulate(MODEL, contacts, rng), SKIN, NOISE) for contacts in (2_000, 200_000)
    )
    dense = Dense(MODEL, NOISE, rng)
    length_m = MODEL.scene.size
    told = 0
    for one in read(MODEL, NOISE, 6, np.random.default_rng(4)):
        made = dense.sample(one, DRAWS, rng, thin)
        assert made.ess > max(quality.LIMIT_ESS, thin.sample(one, 1, rng).ess)
        exact = full.sample(one, 2 * DRAWS, rng)
        half, other = exact.pose[:DRAWS], exact.pose[DRAWS:]
        assert energy_distance(made.pose, half, length_m) < 0.05
        if exact.ess >= 2 * DRAWS:
            told += 1
            floor = energy_distance(half, other, length_m)
            assert energy_distance(made.pose, half, length_m) < floor + 0.01
    assert told >= 2


@pytest.mark.check
def test_no_reading_is_left_out_where_the_bank_alone_leaves_out_most() -> None:
    rng = np.random.default_rng(2)
    to = quality.reference(HALF, NOISE, 6, rng, bank=5_000)
    assert len(to.z) == 6
    assert min(to.ess) >= quality.LIMIT_ESS
    bank = ExactPosterior(simulate(HALF, 5_000, rng), HALF_SKIN, NOISE)
    alone = [bank.sample(one, 1, rng).ess for one in read(HALF, NOISE, 12, rng)]
    assert np.mean(np.array(alone) < quality.LIMIT_ESS) > 0.5
