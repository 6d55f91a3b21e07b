"""The inverse observation model of Marić et al. 2025: a DDPM over poses conditioned on the taxels.

The network predicts v = √ᾱ ε − √(1 − ᾱ) x (Salimans & Ho 2022). This is a noise predictor with
other parameters, which stays well conditioned with few steps. x are whitened poses in the frame of
the model: pose coordinates (the paper's) or contact coordinates.
"""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from taxeld_training.models.base import (
    AnyFrame,
    AnyView,
    Model,
    NetworkConfig,
    standard,
)
from taxeld_training.models.frames import rotated

FOURIER_OCTAVES = 4
REPEATS = 4  # noise levels for each encoded reading in training, as its encoder costs most


def cosine_alpha_bar(steps: int) -> Tensor:
    """ᾱ_t for t = 1..steps of the cosine schedule (Nichol & Dhariwal 2021, eq. 17)."""
    t = torch.linspace(0.0, 1.0, steps + 1, dtype=torch.float64)
    f = torch.cos((t + 0.008) / 1.008 * math.pi / 2.0) ** 2
    return (f[1:] / f[0]).clamp(min=1e-5)


class Denoiser(Model):
    """v(x_t, touch, t): a 4-layer feed-forward network (B, 4) → (B, 4) on Fourier features of a
    whitened pose. The touch's code and the step t shift every hidden layer."""

    mean: Tensor  # (4,) means of the frame's features
    scale: Tensor  # (4,) standard deviations of the frame's features
    alpha_bar: Tensor  # (T,) share of the signal's variance that is left at each step

    def __init__(self, config: NetworkConfig, view: AnyView, frame: AnyFrame) -> None:
        super().__init__(config, view, frame)
        w, e = config.width, config.encoder_width
        self.context = nn.Linear(e, 3 * w)
        self.first = nn.Linear(4 * (1 + 2 * FOURIER_OCTAVES), w)
        self.second = nn.Linear(w, w)
        self.third = nn.Linear(w, w)
        self.out = nn.Linear(w, 4)
        self.register_buffer("mean", torch.zeros(4))
        self.register_buffer("scale", torch.ones(4))
        self.time = nn.Embedding(config.steps, 3 * w)
        self.register_buffer("alpha_bar", cosine_alpha_bar(config.steps).float())
        nn.init.normal_(self.time.weight, std=0.1)

    def fit_scale(self, z: Tensor, live: Tensor, coordinates: Tensor) -> None:
        """Like `Model.fit_scale`: z, live (B, M), coordinates (B, 3)."""
        _, angle = self.view(z, live)
        mean, scale = standard(self.frame.features(self.frame.turned(coordinates, angle)))
        self.mean.copy_(mean)
        self.scale.copy_(scale)

    def run(self, x: Tensor, shift: Tensor) -> Tensor:
        """x (B, 4), shift (B or 1, 3 W) → (B, 4)."""
        angle = torch.cat([x * (0.5 * math.pi * 2**k) for k in range(FOURIER_OCTAVES)], dim=-1)
        features = torch.cat([x, torch.sin(angle), torch.cos(angle)], dim=-1)
        a, b, c = torch.split(shift, self.config.width, dim=-1)
        hidden = functional.silu(self.first(features) + a)
        hidden = hidden + functional.silu(self.second(hidden) + b)
        hidden = hidden + functional.silu(self.third(hidden) + c)
        value: Tensor = self.out(hidden)
        return value

    def loss(self, seen: Tensor, angle: Tensor, coordinates: Tensor) -> Tensor:
        """Like `Model.loss`: features (B, F), angle (B,), coordinates (B, 3) → loss ()."""
        code = self.encoder(seen)
        features = self.frame.features(self.frame.turned(coordinates, angle))
        clean = ((features - self.mean) / self.scale).repeat(REPEATS, 1)
        context = self.context(code).repeat(REPEATS, 1)
        n = len(clean)
        # Each row has a t of its own, stratified over the batch, which lowers the variance.
        t = (torch.randperm(n, device=clean.device) * self.config.steps) // n
        alpha_bar = self.alpha_bar[t, None]
        noise = torch.randn_like(clean)
        noisy = alpha_bar.sqrt() * clean + (1.0 - alpha_bar).sqrt() * noise
        target = alpha_bar.sqrt() * noise - (1.0 - alpha_bar).sqrt() * clean
        return functional.mse_loss(self.run(noisy, context + self.time(t)), target)


class DiffusionSampler(nn.Module):
    """The whole reverse process as one graph, with its noise as an input: ancestral, from the
    noisiest of all T levels to the cleanest."""

    family = "ddpm"
    time: Tensor  # (T, 3 W) the denoiser's embeddings of the noise levels

    def __init__(self, denoiser: Denoiser) -> None:
        super().__init__()
        self.model = denoiser
        self.steps = denoiser.config.steps
        self.alpha_bar: list[float] = (
            denoiser.alpha_bar.tolist()
        )  # numbers, so that they are constants of the graph
        self.register_buffer("time", denoiser.time.weight.detach().clone())

    def forward(self, z: Tensor, live: Tensor, noise: Tensor) -> Tensor:
        """z, live (1, M), noise (T, S, 4) → poses (S, 4): x, y, cos θ, sin θ."""
        net = self.model
        code, angle = net.encode(z, live)
        context = net.context(code)
        x = noise[0]
        for t in reversed(range(self.steps)):
            now, before = self.alpha_bar[t], self.alpha_bar[t - 1] if t else 1.0
            v = net.run(x, context + self.time[t])
            clean = (math.sqrt(now) * x - math.sqrt(1.0 - now) * v).clamp(-4.0, 4.0)
            x = _ancestral(x, clean, now, before, noise[self.steps - t] if t else None)
        return rotated(net.frame.decode(x * net.scale + net.mean), angle)


def _ancestral(x: Tensor, clean: Tensor, now: float, before: float, noise: Tensor | None) -> Tensor:
    """x_{t−1} given x_t and the predicted x_0 (Ho et al. 2020, eq. 6 and 7)."""
    alpha = now / before
    keep = math.sqrt(alpha) * (1.0 - before) / (1.0 - now)
    mean = math.sqrt(before) * (1.0 - alpha) / (1.0 - now) * clean + keep * x
    if noise is None:
        return mean
    return mean + math.sqrt((1.0 - before) / (1.0 - now) * (1.0 - alpha)) * noise
