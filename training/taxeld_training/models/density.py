"""A density model in contact coordinates: p(s | touch) · p(φ, δ | s, touch), sampled in one pass.

A touch leaves one coordinate ambiguous: where along the contact curve it is (s). One dimension
needs no diffusion, as a histogram over s holds any number of modes. Direction φ and depth δ are
sharp given s: a mixture of two Gaussians. Training maximises the likelihood of simulated contacts.
That covers all modes, since the loss of one left out has no bound, and needs no teacher.
"""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from taxeld_training.models.base import (
    AnyView,
    Model,
    NetworkConfig,
    standard,
    uniform_of,
)
from taxeld_training.models.frames import ContactFrame, rotated

BINS = 128  # bins of s: 5 mm each on a cracker box
COMPONENTS = 2  # Gaussians of φ and δ given s
OCTAVES = 5  # octaves of the Fourier features of s
LOG_SCALE = (-6.0, 3.0)


class ContactDensity(Model):
    """See the module; `noise` (1, S, 4) chooses the bin, the component, and two deviations.

    The S values of s are drawn systematically (one offset for all, Kitagawa 1996), so every mode
    gets its share to within one sample.
    """

    family = "density"
    frame: ContactFrame
    mean: Tensor  # (2,) means of φ and δ
    scale: Tensor  # (2,) standard deviations of φ and δ

    def __init__(self, config: NetworkConfig, view: AnyView, frame: ContactFrame) -> None:
        super().__init__(config, view, frame)
        w, e = config.width, config.encoder_width
        self.logits = nn.Linear(e, BINS)
        self.context = nn.Linear(e, 2 * w)
        self.first = nn.Linear(2 * OCTAVES, w)
        self.second = nn.Linear(w, w)
        self.out = nn.Linear(w, 6 * COMPONENTS)
        self.register_buffer("mean", torch.zeros(2))
        self.register_buffer("scale", torch.ones(2))

    def fit_scale(self, z: Tensor, live: Tensor, coordinates: Tensor) -> None:
        """Like `Model.fit_scale`: z, live (B, M), coordinates (B, 3)."""
        _, angle = self.view(z, live)
        mean, scale = standard(self.frame.turned(coordinates, angle)[:, 1:])
        self.mean.copy_(mean)
        self.scale.copy_(scale)

    def loss(self, seen: Tensor, angle: Tensor, coordinates: Tensor) -> Tensor:
        """Like `Model.loss`: features (B, F), angle (B,), coordinates (B, 3) → loss ()."""
        return -self.log_density(seen, angle, coordinates).mean()

    def log_density(self, seen: Tensor, angle: Tensor, coordinates: Tensor) -> Tensor:
        """log p(contact | touch) (B,), up to constants: over bins of s and whitened φ and δ, for
        features (B, F), angle (B,) and coordinates (B, 3)."""
        code = self.encoder(seen)
        turned = self.frame.turned(coordinates, angle)
        s = turned[:, 0]
        log_bins = functional.log_softmax(self.logits(code), dim=1)
        which = (s * BINS).long().clamp(max=BINS - 1)
        log_s = log_bins.gather(1, which[:, None])[:, 0]
        share, centre, log_scale, slope = self._given(s, self.context(code))
        off = (turned[:, None, 1:] - self.mean) / self.scale - centre
        first = off[..., 0] * torch.exp(-log_scale[..., 0])
        second = (off[..., 1] - slope * off[..., 0]) * torch.exp(-log_scale[..., 1])
        log_each = share - 0.5 * (first**2 + second**2) - log_scale.sum(-1)
        return log_s + torch.logsumexp(log_each, dim=1)

    def forward(self, z: Tensor, live: Tensor, noise: Tensor) -> Tensor:
        """z, live (1, M), noise (1, S, 4) → poses (S, 4): x, y, cos θ, sin θ."""
        code, angle = self.encode(z, live)
        draw = noise[0]
        below = torch.cumsum(functional.softmax(self.logits(code)[0], dim=0), dim=0)
        below = below / below[-1]  # rounding must not leave the last draw without a bin
        count = torch.cumsum(torch.ones_like(draw[:, 0]), dim=0)
        at = (count - uniform_of(draw[:1, 0])) / count[-1:]
        which = (below[None] < at[:, None]).sum(dim=1).clamp(max=BINS - 1)
        before = torch.cat([torch.zeros_like(below[:1]), below])[which]
        share_in = ((at - before) / (below[which] - before).clamp(min=1e-9)).clamp(0.0, 1.0)
        s = (which + share_in) / BINS
        log_share, centre, log_scale, slope = self._given(s, self.context(code))
        chosen = (uniform_of(draw[:, 1]) > torch.exp(log_share[:, 0])).float()[:, None]
        centre = torch.lerp(centre[:, 0], centre[:, 1], chosen)
        spread = torch.exp(torch.lerp(log_scale[:, 0], log_scale[:, 1], chosen))
        slope = torch.lerp(slope[:, 0], slope[:, 1], chosen[:, 0])
        first = draw[:, 2] * spread[:, 0]
        second = draw[:, 3] * spread[:, 1] + slope * first
        phi, depth = ((centre + torch.stack([first, second], 1)) * self.scale + self.mean).unbind(1)
        return rotated(self.frame.pose(s, phi, depth), angle)

    def _given(self, s: Tensor, context: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The mixture of whitened φ and δ at s (n,): log shares (n, C), centres (n, C, 2), log
        scales (n, C, 2), and the slope (n, C) of δ on φ; context (n or 1, 2 W)."""
        k = 2.0 * math.pi * s[:, None] * torch.arange(1, OCTAVES + 1, device=s.device)
        a, b = torch.split(context, self.config.width, dim=-1)
        hidden = functional.silu(self.first(torch.cat([torch.sin(k), torch.cos(k)], dim=1)) + a)
        hidden = hidden + functional.silu(self.second(hidden) + b)
        out = self.out(hidden).unflatten(1, (COMPONENTS, 6))
        return (
            functional.log_softmax(out[..., 0], dim=1),
            out[..., 1:3],
            out[..., 3:5].clamp(*LOG_SCALE),
            out[..., 5],
        )
