"""Variants of the models, by their parts, and their training: AdamW, cosine decay, an exponential
average of the weights."""

import copy
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from taxeld.model.noise import Noise
from taxeld.model.observation import ObservationModel
from taxeld_training.models import views
from taxeld_training.models.base import AnyFrame, AnyView, Model, NetworkConfig
from taxeld_training.models.dataset import Batches, SimulatedTouches
from taxeld_training.models.density import ContactDensity
from taxeld_training.models.diffusion import Denoiser, DiffusionSampler
from taxeld_training.models.export import AnySampler
from taxeld_training.models.frames import ContactFrame, PoseFrame

SCALE_BATCH = 10_000
TOLD = 100  # updates from one word of progress to the next


@dataclass(frozen=True)
class TrainConfig:
    """The settings that repeat a training; saved inside the ONNX file."""

    contacts: int = 300_000  # simulated once; noise, gain and dead taxels are drawn anew each batch
    batch: int = 256  # readings an update
    updates: int = 8_000
    learning_rate: float = 2e-3
    average: float = 0.999  # decay of the exponential average of the weights
    seed: int = 0


@dataclass(frozen=True)
class Variant:
    """One model: family, sizes, view of the touch, frame of the pose, and its training."""

    family: str  # density | diffusion
    network: NetworkConfig
    training: TrainConfig
    view: str = "best"  # best | plain
    frame: str = "contact"  # contact | pose

    @property
    def kind(self) -> str:
        """The proposal's name in the daemon."""
        return "ddpm" if self.family == "diffusion" else self.family


def density(width: int = 64, encoder_width: int = 256) -> Variant:
    """One pass; `width` is that of the layers that run once a hypothesis."""
    network = NetworkConfig(width, encoder_width)
    return Variant("density", network, TrainConfig(updates=12_000))


def diffusion() -> Variant:
    """A diffusion in contact coordinates."""
    return Variant("diffusion", NetworkConfig(128, 160), TrainConfig(updates=10_000))


def paper() -> Variant:
    """Marić et al. 2025: 10⁴ contacts, T = 100, symmetry not used. They do not state their width;
    it is 256 here."""
    return Variant(
        "diffusion",
        NetworkConfig(256, 256, encoder_depth=1),
        TrainConfig(contacts=10_000),
        view="plain",
        frame="pose",
    )


def trained_with(
    variant: Variant, effort: float, contacts: int | None = None, seed: int | None = None
) -> Variant:
    """The variant with a share of its updates, and at most its own number of contacts."""
    own = variant.training
    training = replace(
        own,
        updates=max(2, round(own.updates * effort)),
        contacts=min(contacts or own.contacts, own.contacts),
        seed=own.seed if seed is None else seed,
    )
    return replace(variant, training=training)


def fit(
    variant: Variant,
    model: ObservationModel,
    noise: Noise,
    touches: SimulatedTouches,
    progress: Callable[[float], None] = lambda _: None,
) -> Model:
    """The trained model of a variant, on its share of `touches`, read as a filter sees them. A
    batch is drawn and looked at on a second core while the model learns from the one before.
    `progress` is called with the share that is done."""
    config = variant.training
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    torch.manual_seed(config.seed)
    network = _untrained(variant, model).to(device)
    count = config.contacts
    mine = SimulatedTouches(touches.pose[:count], touches.activation[:count])
    coordinates = network.frame.encode(mine.pose)
    batches = Batches(mine, coordinates, model.leak, noise, config.seed, device)
    with torch.no_grad():
        network.fit_scale(*batches.draw(SCALE_BATCH))  # whitened by a large batch
    averaged = copy.deepcopy(network)
    weights: list[Tensor] = list(network.parameters())
    averages: list[Tensor] = list(averaged.parameters())
    optimizer = torch.optim.AdamW(weights, lr=config.learning_rate, weight_decay=1e-4, fused=True)
    warm_up = max(1, config.updates // 50)
    schedule = torch.optim.lr_scheduler.SequentialLR(
        optimizer,
        [
            torch.optim.lr_scheduler.LinearLR(optimizer, 0.05, 1.0, warm_up),
            torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, config.updates - warm_up, 1e-5),
        ],
        [warm_up],
    )

    def drawn() -> tuple[Tensor, Tensor, Tensor]:
        """Features (B, F), angle (B,) and coordinates (B, 3) of the next batch."""
        z, live, coordinates = batches.draw(config.batch)
        return *network.view(z, live), coordinates

    with ThreadPoolExecutor(1) as beside:
        ahead = beside.submit(drawn)
        for update in range(1, config.updates + 1):
            batch, ahead = ahead.result(), beside.submit(drawn)
            loss = network.loss(*batch)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()  # type: ignore[no-untyped-call]
            nn.utils.clip_grad_norm_(weights, 1.0)
            optimizer.step()
            schedule.step()
            decay = min(config.average, update / (update + 10.0))
            with torch.no_grad():
                torch._foreach_lerp_(averages, weights, 1.0 - decay)
            if update % TOLD == 0:
                progress(update / config.updates)
    progress(1.0)
    return averaged.cpu().eval()


def sampler_of(trained: Model) -> AnySampler:
    """The sampler that runs a trained model."""
    if isinstance(trained, Denoiser):
        return DiffusionSampler(trained)
    assert isinstance(trained, ContactDensity)  # noqa: S101
    return trained


def _untrained(variant: Variant, model: ObservationModel) -> Model:
    """The model of a variant before its training, which knows its sizes."""
    view: AnyView = views.best(model.layout)
    if variant.view == "plain":
        view = views.Plain(model.layout)
    frame: AnyFrame = PoseFrame() if variant.frame == "pose" else ContactFrame(model)
    if isinstance(frame, ContactFrame) and variant.family == "density":
        return ContactDensity(variant.network, view, frame)
    return Denoiser(variant.network, view, frame)
