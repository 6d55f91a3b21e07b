"""Variants of the models, by their parts, for `build` and the experiments."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

from taxeld.model.noise import Noise
from taxeld.model.observation import ObservationModel
from taxeld_training.models import views
from taxeld_training.models.base import AnyFrame, AnyView, Model, NetworkConfig
from taxeld_training.models.dataset import SimulatedTouches
from taxeld_training.models.density import ContactDensity
from taxeld_training.models.diffusion import Denoiser, DiffusionSampler
from taxeld_training.models.export import AnySampler
from taxeld_training.models.frames import ContactFrame, PoseFrame
from taxeld_training.models.train import TrainConfig, shared, train_beside


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

    def describe(self) -> dict[str, Any]:
        """For a file's metadata: what the trained model depends on."""
        return asdict(self)


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
    variant: Variant, model: ObservationModel, noise: Noise, touches: SimulatedTouches
) -> Model:
    """The trained model of a variant, on its share of `touches`."""
    return fit_beside([variant], model, noise, touches)[0]


def fit_beside(
    given: Sequence[Variant],
    model: ObservationModel,
    noise: Noise,
    touches: SimulatedTouches,
    progress: Callable[[float], None] = lambda _: None,
) -> list[Model]:
    """Models as `fit` makes each. Those that see the same batches are trained side by side: to draw
    them takes a good part of the time. `progress` is called with the share of them that is done."""
    done: dict[int, Model] = {}
    alike: dict[tuple[Any, ...], list[int]] = {}
    for k, variant in enumerate(given):
        kind = variant.view, variant.frame, *shared(variant.training)
        alike.setdefault(kind, []).append(k)
    for (_, _, count, *_), places in alike.items():
        mine = SimulatedTouches(
            touches.pose[:count], touches.activation[:count], touches.dropped_share
        )
        runs = [(partial(untrained, given[k], model), given[k].training) for k in places]
        made = train_beside(runs, mine, model.leak, noise, progress)
        done |= dict(zip(places, made, strict=True))
    return [done[k] for k in range(len(given))]


def sampler_of(trained: Model) -> AnySampler:
    """The sampler that runs a trained model."""
    if isinstance(trained, Denoiser):
        return DiffusionSampler(trained)
    assert isinstance(trained, ContactDensity)  # noqa: S101
    return trained


def untrained(variant: Variant, model: ObservationModel) -> Model:
    """The model of a variant before its training, which knows its sizes."""
    view: AnyView = views.best(model.layout)
    if variant.view == "plain":
        view = views.Plain(model.layout)
    frame: AnyFrame = PoseFrame() if variant.frame == "pose" else ContactFrame(model)
    if isinstance(frame, ContactFrame) and variant.family == "density":
        return ContactDensity(variant.network, view, frame)
    return Denoiser(variant.network, view, frame)
