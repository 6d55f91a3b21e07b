"""The models there are, by what they are made of; for `build` and the experiments."""

from dataclasses import asdict, dataclass, replace
from typing import Any

from taxeld.observation import Noise, ObservationModel
from taxeld_training import views
from taxeld_training.dataset import Touches
from taxeld_training.density import ContactDensity
from taxeld_training.diffusion import Denoiser, Sampler, Solver
from taxeld_training.export import AnySampler
from taxeld_training.frames import ContactFrame, PoseFrame
from taxeld_training.generator import Generator
from taxeld_training.models import AnyFrame, AnyView, Model, NetworkConfig
from taxeld_training.train import Progress, TrainConfig, train


@dataclass(frozen=True)
class Variant:
    """One model: family, sizes, how it sees the touch and the pose, and its training."""

    family: str  # density | diffusion | generator
    network: NetworkConfig
    training: TrainConfig
    view: str = "best"  # best | plain
    frame: str = "contact"  # contact | pose
    samplers: tuple[tuple[Solver, int], ...] = ()  # of a diffusion

    @property
    def kind(self) -> str:
        """The daemon's word for it."""
        return "ddpm" if self.family == "diffusion" else self.family

    def describe(self) -> dict[str, Any]:
        """For a file's metadata."""
        return {key: value for key, value in asdict(self).items() if key != "samplers"}


def density(width: int = 64, encoder_width: int = 256, encoder_depth: int = 5) -> Variant:
    """One pass; the width is that of the layers that run once a hypothesis."""
    network = NetworkConfig(width, encoder_width, encoder_depth)
    return Variant("density", network, TrainConfig(updates=12_000))


def generator(width: int = 128) -> Variant:
    """One pass, trained by the energy score."""
    return Variant("generator", NetworkConfig(width), TrainConfig(updates=4_000))


def diffusion(
    width: int = 128,
    samplers: tuple[tuple[Solver, int], ...] = ((Solver.DDPM, 100),),
) -> Variant:  # fmt: skip
    """Any of its solvers' steps; in the contact's coordinates."""
    training = TrainConfig(updates=10_000)
    return Variant("diffusion", NetworkConfig(width, 160), training, samplers=samplers)


def paper() -> Variant:
    """Marić et al. 2025: 10⁴ contacts, T = 100, no use of symmetry; width 256 stands in for their
    unstated one."""
    return Variant(
        "diffusion", NetworkConfig(256, 256, encoder_depth=1),
        TrainConfig(contacts=10_000), view="plain", frame="pose",
        samplers=((Solver.DDPM, 100),),
    )  # fmt: skip


def trained_with(
    variant: Variant, effort: float, contacts: int | None = None, seed: int | None = None
) -> Variant:
    """The same, trained with a share of its updates; contacts are at most the variant's own."""
    own = variant.training
    training = replace(
        own,
        updates=max(2, round(own.updates * effort)),
        contacts=min(contacts or own.contacts, own.contacts),
        seed=own.seed if seed is None else seed,
    )
    return replace(variant, training=training)


def fit(
    variant: Variant, model: ObservationModel, noise: Noise, touches: Touches, progress: Progress
) -> Model:
    """The trained model of a variant, on its share of `touches`."""
    count = variant.training.contacts
    mine = Touches(touches.pose[:count], touches.activation[:count], touches.dropped_share)
    return train(lambda: _make(variant, model), variant.training, mine, noise, progress)


def samplers(variant: Variant, trained: Model) -> dict[str, AnySampler]:
    """What the trained model can be run as, by name."""
    if isinstance(trained, Denoiser):
        return {
            f"{solver}-{steps}": Sampler(trained, solver, steps)
            for solver, steps in variant.samplers
        }
    assert isinstance(trained, ContactDensity | Generator)  # noqa: S101
    return {f"{variant.family}-{variant.network.width}": trained}


def _make(variant: Variant, model: ObservationModel) -> Model:
    view: AnyView = views.best(model.layout)
    if variant.view == "plain":
        view = views.Plain(model.layout)
    frame: AnyFrame = PoseFrame() if variant.frame == "pose" else ContactFrame(model)
    if isinstance(frame, ContactFrame) and variant.family == "density":
        return ContactDensity(variant.network, view, frame)
    if variant.family == "generator":
        made = Generator(variant.network, view, frame)
        made.length_m = model.scene.size
        return made
    return Denoiser(variant.network, view, frame)
