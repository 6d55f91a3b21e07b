"""Every model learns the posterior, and its ONNX file gives what torch gives."""

import json
from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import pytest
import torch

from taxeld.model.noise import Noise
from taxeld.model.observation import ObservationModel
from taxeld.proposals.analytic import Projection
from taxeld.proposals.sampler import Sampler
from taxeld_training.limits import quality
from taxeld_training.models import variants
from taxeld_training.models.base import NetworkConfig
from taxeld_training.models.dataset import SimulatedTouches, simulate
from taxeld_training.models.density import BINS, ContactDensity
from taxeld_training.models.export import export, rounded
from taxeld_training.models.frames import ContactFrame
from taxeld_training.models.variants import Variant
from taxeld_training.models.views import best

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
    network = variants.fit(small, model, Noise(), touches)
    return variants.sampler_of(network)


@pytest.mark.parametrize(
    ("name", "skin"),
    [
        ("density", "ring_model"),
        ("density", "half_model"),
        ("ddpm", "ring_model"),
        ("paper", "half_model"),
    ],
)
def test_onnx_equals_torch_for_any_number_of_samples(
    name: str, skin: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    model: ObservationModel = request.getfixturevalue(skin)
    taxels = len(model.layout)
    some = simulate(model, 2000, np.random.default_rng(0))
    sampler = fitted(SMALL[name], model, some, 3)
    path = tmp_path / "s.onnx"
    export(sampler, taxels, path, {"training": {"seed": 1}})  # type: ignore[arg-type]
    session = ort.InferenceSession(path, providers=["CPUExecutionProvider"])
    for i, samples in enumerate((1, 3, 250)):
        z = torch.from_numpy(some.activation[i : i + 1])
        live = (torch.rand(1, taxels) > 0.2).float()
        noise = torch.randn(sampler.noise_steps, samples, 4)  # type: ignore[call-overload]
        with torch.no_grad():
            expected = rounded(sampler)(z, live, noise).numpy()  # type: ignore[arg-type]
        inputs = {"z": z.numpy(), "live": live.numpy(), "noise": noise.numpy()}
        gap = np.abs(session.run(None, inputs)[0] - expected)
        assert np.quantile(gap, 0.98) < 1e-3
    metadata = {p.key: json.loads(p.value) for p in onnx.load(path).metadata_props}
    assert metadata == {"training": {"seed": 1}}


def test_a_trained_model_is_near_the_posterior(
    ring_model: ObservationModel, touches: SimulatedTouches, tmp_path: Path
) -> None:
    to = quality.reference(ring_model, Noise(), 20, np.random.default_rng(1), bank=40_000)
    sampler = fitted(variants.density(32), ring_model, touches, 300)
    export(sampler, len(ring_model.layout), tmp_path / "s.onnx", {})  # type: ignore[arg-type]
    rng = np.random.default_rng(2)
    learned = Sampler((tmp_path / "s.onnx").read_bytes(), ring_model.layout, "density", tmp_path)
    uninformed = quality.distances(Projection(ring_model), to, rng).mean()
    assert quality.distances(learned, to, rng).mean() < 0.12 * uninformed


def test_a_model_trained_beside_others_is_the_one_that_is_trained_alone(
    ring_model: ObservationModel, touches: SimulatedTouches
) -> None:
    """Those of other batches, and of fewer updates, among them."""
    few = {"density": 4, "ddpm": 6, "paper": 5}
    given = [
        variants.trained_with(SMALL[name], updates / TRAINING.updates, 5_000, 0)
        for name, updates in few.items()
    ]
    beside = variants.fit_beside(given, ring_model, Noise(), touches)
    for variant, one in zip(given, beside, strict=True):
        alone = variants.fit(variant, ring_model, Noise(), touches)
        for name, weight in alone.state_dict().items():
            assert torch.equal(weight, one.state_dict()[name]), (variant.family, name)


def density(model: ObservationModel) -> ContactDensity:
    torch.manual_seed(0)
    return ContactDensity(NetworkConfig(8, 16), best(model.layout), ContactFrame(model)).eval()


def test_the_densitys_samples_follow_its_histogram(ring_model: ObservationModel) -> None:
    """Counts a bin against the probabilities that the network gives, to within one sample."""
    net = density(ring_model)
    with torch.no_grad():
        net.logits.bias.copy_(torch.randn(BINS, generator=torch.Generator().manual_seed(1)))
        net.logits.weight.mul_(0.1)
    z = torch.zeros(1, 32)
    z[0, 5] = 0.7
    live, noise = torch.ones(1, 32), torch.randn(1, 20_000, 4)
    with torch.no_grad():
        share = torch.softmax(net.logits(net.encode(z, live)[0])[0], 0)
        four = net(z, live, noise).double().numpy()
    poses = np.column_stack([four[:, 0], four[:, 1], np.arctan2(four[:, 3], four[:, 2])])
    s = net.frame.encode(poses)[:, 0]
    counts = torch.bincount((s * BINS).long().clamp(max=BINS - 1), minlength=BINS) / 20_000
    assert (counts - share).abs().max() < 0.004  # the lookup of s rounds at a bin's edge


def test_the_density_integrates_to_one(ring_model: ObservationModel) -> None:
    net = density(ring_model)
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
