"""The inverse observation model: a DDPM over poses conditioned on the taxels (Marić et al. 2025).

Poses are those of the object in the sensor frame, (x, y, cos θ, sin θ), whitened. The network
predicts v = √ᾱ ε − √(1 − ᾱ) x (Salimans & Ho 2022), a reparametrised noise predictor that is well
conditioned when few steps are taken. Touches are turned so that the strongest taxel's sector comes
to angle 0, which is exact on a layout with that rotation symmetry and leaves less to learn.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

FOURIER_OCTAVES = 4


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of the denoiser; saved inside the ONNX file."""

    taxels: int
    steps: int = 100  # T
    width: int = 128  # of the three hidden layers, run once a step and hypothesis
    encoder_width: int = 160  # of the taxels' encoder, run once a touch: its cost disappears


def cosine_alpha_bar(steps: int) -> Tensor:
    """ᾱ_t for t = 1..steps of the cosine schedule (Nichol & Dhariwal 2021, eq. 17)."""
    t = torch.linspace(0.0, 1.0, steps + 1, dtype=torch.float64)
    f = torch.cos((t + 0.008) / 1.008 * math.pi / 2.0) ** 2
    return (f[1:] / f[0]).clamp(min=1e-5)


class Denoiser(nn.Module):
    """v(x_t, taxels, t): a 4-layer feed-forward network beside an encoder of the taxels."""

    mean: Tensor  # (4,) and
    scale: Tensor  # (4,) of the poses, which whitening takes away
    alpha_bar: Tensor  # (T,)

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        w, e = config.width, config.encoder_width
        self.encoder = nn.Sequential(
            nn.Linear(2 * config.taxels, e), nn.SiLU(), nn.Linear(e, e), nn.SiLU()
        )
        self.context = nn.Linear(e, 3 * w)
        self.time = nn.Embedding(config.steps, 3 * w)
        self.first = nn.Linear(4 * (1 + 2 * FOURIER_OCTAVES), w)
        self.second = nn.Linear(w, w)
        self.third = nn.Linear(w, w)
        self.out = nn.Linear(w, 4)
        self.register_buffer("mean", torch.zeros(4))
        self.register_buffer("scale", torch.ones(4))
        self.register_buffer("alpha_bar", cosine_alpha_bar(config.steps).float())
        nn.init.normal_(self.time.weight, std=0.1)

    def encode(self, z: Tensor, live: Tensor) -> Tensor:
        """The taxels' share of each hidden layer: z, live (B, M) → (B, 3 W)."""
        context: Tensor = self.context(self.encoder(torch.cat([z * live, live], dim=-1)))
        return context

    def forward(self, x: Tensor, shift: Tensor) -> Tensor:
        """v of noisy poses x (B, 4), whitened; shift (B or 1, 3 W) = context + time."""
        angle = torch.cat([x * (0.5 * math.pi * 2**k) for k in range(FOURIER_OCTAVES)], dim=-1)
        features = torch.cat([x, torch.sin(angle), torch.cos(angle)], dim=-1)
        a, b, c = shift.chunk(3, dim=-1)
        hidden = nn.functional.silu(self.first(features) + a)
        hidden = hidden + nn.functional.silu(self.second(hidden) + b)
        hidden = hidden + nn.functional.silu(self.third(hidden) + c)
        v: Tensor = self.out(hidden)
        return v


class Sampler(nn.Module):
    """The whole reverse process as one graph whose noise is an input.

    Ancestral DDPM sampling with all T steps, or DDIM (Song et al. 2021, η = 0) with fewer.
    """

    time: Tensor  # (steps, 3 W) the denoiser's own, at the steps taken

    def __init__(self, denoiser: Denoiser, steps: int) -> None:
        super().__init__()
        self.denoiser = denoiser
        total = denoiser.config.steps
        self.ancestral = steps == total
        self.alpha_bar: list[float] = denoiser.alpha_bar.tolist()  # constants of the graph
        self.times = [round((i + 1) * total / steps) - 1 for i in range(steps)][::-1]
        self.register_buffer("time", denoiser.time.weight.detach()[self.times].clone())

    @property
    def noise_steps(self) -> int:
        """How many noises a sample takes: the first axis of the `noise` input."""
        return len(self.times) if self.ancestral else 1

    def forward(self, z: Tensor, live: Tensor, noise: Tensor) -> Tensor:
        """z, live (1, M), noise (noise_steps, S, 4) → poses (S, 4): x, y, cos θ, sin θ."""
        net = self.denoiser
        context = net.encode(z, live)
        x = noise[0]
        for i, t in enumerate(self.times):
            now = self.alpha_bar[t]
            before = self.alpha_bar[self.times[i + 1]] if i + 1 < len(self.times) else 1.0
            v = net(x, context + self.time[i])
            clean = (math.sqrt(now) * x - math.sqrt(1.0 - now) * v).clamp(-4.0, 4.0)
            if self.ancestral:
                alpha = now / before
                keep = math.sqrt(alpha) * (1.0 - before) / (1.0 - now)
                x = math.sqrt(before) * (1.0 - alpha) / (1.0 - now) * clean + keep * x
                if before < 1.0:
                    sigma = math.sqrt((1.0 - before) / (1.0 - now) * (1.0 - alpha))
                    x = x + sigma * noise[i + 1]
            else:
                epsilon = (x - math.sqrt(now) * clean) / math.sqrt(1.0 - now)
                x = math.sqrt(before) * clean + math.sqrt(1.0 - before) * epsilon
        return x * net.scale + net.mean


def flops(config: NetworkConfig, steps: int, samples: int) -> int:
    """Multiply-adds times two of one call."""
    w, e, m = config.width, config.encoder_width, config.taxels
    once = 2 * m * e + e * e + e * 3 * w
    each = 4 * (1 + 2 * FOURIER_OCTAVES) * w + 2 * w * w + 4 * w
    return 2 * (once + steps * samples * each)
