"""The parts that all inverse observation models share: view of the touch, pose frame, encoder."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from taxeld_training.models.frames import ContactFrame, PoseFrame
from taxeld_training.models.views import Centred, Plain, Turned

AnyView = Plain | Turned | Centred
AnyFrame = PoseFrame | ContactFrame


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of a network; saved inside the ONNX file."""

    width: int = 64  # width of the layers that run once a hypothesis
    encoder_width: int = 192  # width of the encoder, which runs once a touch and costs little
    encoder_depth: int = 5  # layers of the encoder: a mug's yaw depends on a tenth of a millimetre
    steps: int = 100  # number T of a diffusion's noise levels


class Model(nn.Module, ABC):
    """A network for p(pose | touch): it can be trained, and run as one graph."""

    steps = 1  # noises a sample takes: the first axis of the `noise` input

    def __init__(self, config: NetworkConfig, view: AnyView, frame: AnyFrame) -> None:
        super().__init__()
        self.config, self.view, self.frame = config, view, frame
        e = config.encoder_width
        self.encoder = nn.Sequential(
            nn.Linear(view.width, e),
            nn.SiLU(),
            *(Residual(e) for _ in range(config.encoder_depth - 1)),
        )

    def encode(self, z: Tensor, live: Tensor) -> tuple[Tensor, Tensor]:
        """z, live (B, M) → code (B, E), and the angle (B,) by which the view turned the touch."""
        seen, angle = self.view(z, live)
        code: Tensor = self.encoder(seen)
        return code, angle

    @abstractmethod
    def fit_scale(self, z: Tensor, live: Tensor, coordinates: Tensor) -> None:
        """Set mean and scale for whitening from a large batch: z, live (B, M) and coordinates (B,
        3)."""

    @abstractmethod
    def loss(self, seen: Tensor, angle: Tensor, coordinates: Tensor) -> Tensor:
        """The training loss () for touches as the view shows them, features (B, F) and angle (B,),
        and coordinates (B, 3) of the true poses."""


class Residual(nn.Module):
    """A layer that adds to its input, so that many can be stacked."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.layer = nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """x (B, E) → (B, E)."""
        return x + nn.functional.silu(self.layer(x))


def standard(values: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation (F,) of the columns of values (n, F), the latter never 0."""
    return values.mean(0), values.std(0).clamp(min=1e-6)


def uniform_of(noise: Tensor) -> Tensor:
    """Standard normal values of any shape (...) → uniform ones over 0..1."""
    return 0.5 * (1.0 + torch.erf(noise * 0.5**0.5))
