"""Variants of the models, by their parts, and their training: AdamW, cosine decay, an exponential
average of the weights."""

import copy
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

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


def density(width: int = 64, encoder_width: int = 256, encoder_depth: int = 5) -> Variant:
    """One pass; `width` is that of the layers that run once a hypothesis."""
    network = NetworkConfig(width, encoder_width, encoder_depth)
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
    given: Sequence[Variant],
    model: ObservationModel,
    noise: Noise,
    touches: SimulatedTouches,
    progress: Callable[[float], None] = lambda _: None,
) -> list[Model]:
    """The trained model of each variant, on its share of `touches`, read as a filter sees them.
    Those that see the same batches are trained side by side: to draw them takes a good part of the
    time. `progress` is called with the share of them that is done."""
    done: dict[Variant, Model] = {}
    alike: dict[tuple[Any, ...], list[Variant]] = {}
    for variant in given:
        own = variant.training
        kind = own.contacts, own.batch, own.seed, variant.view, variant.frame
        alike.setdefault(kind, []).append(variant)
    for (count, *_), some in alike.items():
        mine = SimulatedTouches(
            touches.pose[:count], touches.activation[:count], touches.dropped_share
        )
        made = _fit_alike(some, model, noise, mine, progress)
        done |= dict(zip(some, made, strict=True))
    return [done[variant] for variant in given]


def _fit_alike(
    given: Sequence[Variant],
    model: ObservationModel,
    noise: Noise,
    touches: SimulatedTouches,
    progress: Callable[[float], None],
) -> list[Model]:
    """Models of variants with one view, one frame and the same batches. A batch is drawn and looked
    at once for all of them, on a second core while they learn from the one before."""
    runs = [_Run(variant, model) for variant in given]
    config = given[0].training
    coordinates = runs[0].model.frame.encode(touches.pose)
    batches = Batches(touches, coordinates, model.leak, noise, config.seed, runs[0].device)
    first = batches.draw(SCALE_BATCH)
    for run in runs:
        run.begin(first)

    def drawn() -> tuple[Tensor, Tensor, Tensor]:
        """Features (B, F), angle (B,) and coordinates (B, 3) of the next batch."""
        z, live, coordinates = batches.draw(config.batch)
        return *runs[0].model.view(z, live), coordinates

    updates = max(run.config.updates for run in runs)
    with ThreadPoolExecutor(1) as beside:
        ahead = beside.submit(drawn)
        for update in range(1, updates + 1):
            batch, ahead = ahead.result(), beside.submit(drawn)
            for run in runs:
                if update <= run.config.updates:
                    run.update(*batch, update)
            if update % TOLD == 0:
                progress(update / updates)
    progress(1.0)
    return [run.averaged.cpu().eval() for run in runs]


class _Run:
    """A model on its way. It draws from torch's generator as if it were the only one."""

    def __init__(self, variant: Variant, model: ObservationModel) -> None:
        torch.manual_seed(variant.training.seed)
        self.config = variant.training
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self.model = _untrained(variant, model).to(self.device)
        self._drawn = torch.get_rng_state()

    def begin(self, batch: tuple[Tensor, Tensor, Tensor]) -> None:
        """Whiten by a large batch: z, live (B, M) and coordinates (B, 3)."""
        with torch.no_grad():
            self.model.fit_scale(*batch)
        self.averaged = copy.deepcopy(self.model)
        self._weights: list[Tensor] = list(self.model.parameters())
        self._averages: list[Tensor] = list(self.averaged.parameters())
        self._optimizer = torch.optim.AdamW(
            self._weights, lr=self.config.learning_rate, weight_decay=1e-4, fused=True
        )
        updates = self.config.updates
        warm_up = max(1, updates // 50)
        self._schedule = torch.optim.lr_scheduler.SequentialLR(
            self._optimizer,
            [
                torch.optim.lr_scheduler.LinearLR(self._optimizer, 0.05, 1.0, warm_up),
                torch.optim.lr_scheduler.CosineAnnealingLR(
                    self._optimizer, updates - warm_up, 1e-5
                ),
            ],
            [warm_up],
        )

    def update(self, seen: Tensor, angle: Tensor, coordinates: Tensor, number: int) -> None:
        """The update of a number, from 1, by features (B, F), angle (B,), coordinates (B, 3)."""
        torch.set_rng_state(self._drawn)
        loss = self.model.loss(seen, angle, coordinates)
        self._drawn = torch.get_rng_state()
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self._weights, 1.0)
        self._optimizer.step()
        self._schedule.step()
        decay = min(self.config.average, number / (number + 10.0))
        with torch.no_grad():
            torch._foreach_lerp_(self._averages, self._weights, 1.0 - decay)


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
