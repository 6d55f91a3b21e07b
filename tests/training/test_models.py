"""Models: their coordinates and views mean what they say, every one learns the posterior, and its
ONNX file gives what torch gives."""

import json
from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import pytest
import torch
from torch import Tensor

from taxeld.arrays import Poses
from taxeld.model import contacts, se2
from taxeld.model.noise import Noise
from taxeld.model.observation import ObservationModel
from taxeld.proposals.analytic import Projection
from taxeld.proposals.sampler import Sampler
from taxeld_training.limits import quality
from taxeld_training.models import variants
from taxeld_training.models.base import NetworkConfig
from taxeld_training.models.dataset import SimulatedTouches, simulate
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
        gap = np.abs(session.run(None, inputs)[0] - expected)
        assert np.quantile(gap, 0.98) < 1e-3
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
    config = NetworkConfig(steps=100, width=4)
    net = GaussianDenoiser(config, Plain(SKIN), PoseFrame())
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
    assert isinstance(view, Centred)
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
