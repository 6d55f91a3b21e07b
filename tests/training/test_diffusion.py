"""Samplers against closed forms, and their ONNX against torch."""

import json
from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import pytest
import torch
from torch import Tensor

from taxeld_training.diffusion import Denoiser, NetworkConfig, Sampler, cosine_alpha_bar, flops
from taxeld_training.export import export

STEPS = 100


class GaussianDenoiser(Denoiser):
    """The exact v of data N(mean, sd²): E[ε|x] and E[x₀|x] are linear in x."""

    centre, sd = 0.5, 0.3

    def encode(self, z: Tensor, live: Tensor) -> Tensor:  # noqa: ARG002
        return torch.zeros(1, 3 * self.config.width)

    def forward(self, x: Tensor, shift: Tensor) -> Tensor:
        t = int(shift[0, 0].item())
        a = self.alpha_bar[t]
        variance = a * self.sd**2 + 1.0 - a
        clean = self.centre + a.sqrt() * self.sd**2 / variance * (x - a.sqrt() * self.centre)
        noise = (x - a.sqrt() * clean) / (1.0 - a).sqrt()
        return a.sqrt() * noise - (1.0 - a).sqrt() * clean


def gaussian() -> GaussianDenoiser:
    net = GaussianDenoiser(NetworkConfig(taxels=4, steps=STEPS, width=4))
    with torch.no_grad():
        net.time.weight.copy_(torch.arange(STEPS)[:, None].expand(-1, 12))
    return net


@pytest.mark.parametrize(("steps", "tolerance"), [(100, 0.02), (50, 0.02), (10, 0.07)])
def test_samplers_reach_the_gaussian_they_are_given(steps: int, tolerance: float) -> None:
    """Few DDIM steps are known to draw a Gaussian too narrow; how much is bounded here."""
    sampler = Sampler(gaussian(), steps)
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(sampler.noise_steps, 20_000, 4, generator=generator)
    with torch.no_grad():
        drawn = sampler(torch.zeros(1, 4), torch.ones(1, 4), noise)
    assert torch.allclose(drawn.mean(0), torch.full((4,), 0.5), atol=0.01)
    assert torch.allclose(drawn.std(0), torch.full((4,), 0.3), atol=tolerance)


def test_the_noise_schedule_falls_from_all_signal_to_none() -> None:
    alpha_bar = cosine_alpha_bar(STEPS)
    assert len(alpha_bar) == STEPS
    assert (alpha_bar.diff() < 0).all()
    assert alpha_bar[0] > 0.99
    assert alpha_bar[-1] < 1e-4


@pytest.mark.parametrize("steps", [100, 7, 1])
def test_the_last_step_taken_is_the_cleanest(steps: int) -> None:
    sampler = Sampler(Denoiser(NetworkConfig(taxels=4, steps=STEPS, width=4)), steps)
    assert len(sampler.times) == steps
    assert sampler.times[0] == STEPS - 1
    assert sampler.times == sorted(set(sampler.times), reverse=True)


@pytest.mark.parametrize("steps", [100, 5])
def test_onnx_equals_torch_for_any_number_of_samples(tmp_path: Path, steps: int) -> None:
    torch.manual_seed(1)
    net = Denoiser(NetworkConfig(taxels=6, steps=STEPS, width=8, encoder_width=8))
    net.mean.copy_(torch.tensor([0.1, 0.2, 0.0, 0.0]))
    sampler = Sampler(net, steps)
    path = tmp_path / "s.onnx"
    export(sampler, path, {"training": {"seed": 1}})
    session = ort.InferenceSession(path, providers=["CPUExecutionProvider"])
    for samples in (1, 3, 250):
        z, live = torch.rand(1, 6), (torch.rand(1, 6) > 0.2).float()
        noise = torch.randn(sampler.noise_steps, samples, 4)
        with torch.no_grad():
            expected = sampler(z, live, noise).numpy()
        inputs = {"z": z.numpy(), "live": live.numpy(), "noise": noise.numpy()}
        assert np.allclose(session.run(None, inputs)[0], expected, atol=1e-4)
    metadata = {p.key: json.loads(p.value) for p in onnx.load(path).metadata_props}
    assert metadata == {"training": {"seed": 1}}


def test_a_dead_taxels_reading_does_not_reach_the_network() -> None:
    net = Denoiser(NetworkConfig(taxels=6, width=8, encoder_width=8))
    live = torch.tensor([[1.0, 0, 1, 1, 1, 1]])
    one, other = torch.zeros(1, 6), torch.zeros(1, 6)
    other[0, 1] = 1.0
    assert torch.equal(net.encode(one, live), net.encode(other, live))


def test_operations_grow_with_steps_and_not_with_the_encoder() -> None:
    small, large = NetworkConfig(80, encoder_width=10), NetworkConfig(80, encoder_width=500)
    assert flops(large, 10, 100) - flops(large, 5, 100) == flops(small, 10, 100) - flops(
        small, 5, 100
    )
