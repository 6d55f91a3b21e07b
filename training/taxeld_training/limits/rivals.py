"""General simulation-based inference as a rival: estimators of the sbi library, trained as shipped.

Each learns p(pose | taxels) from as many simulated contacts as the stored table holds. Their noise
is drawn once, and they are turned to the strongest taxel as for all models. Settings are sbi's
defaults unless stated below.
"""

import contextlib
import io
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from taxeld.arrays import Bools, Floats, Poses
from taxeld.errors import SetupError
from taxeld.model.observation import Noise, ObservationModel
from taxeld.model.proposal import Proposal
from taxeld_training.models import views
from taxeld_training.models.base import AnyView, standard
from taxeld_training.models.dataset import Batches, simulate
from taxeld_training.models.frames import PoseFrame, rotated

CONTACTS = 10_000
# name: simulated contacts, and the most epochs: about a minute on a core, or ten of the density's
# number of contacts
RIVALS = {
    "npe": (CONTACTS, 50),
    "npse": (CONTACTS, 150),
    "fmpe": (CONTACTS, 200),
    "npe-3e5": (300_000, 19),
    "npse-3e5": (300_000, 25),
    "fmpe-3e5": (300_000, 28),
}
# sbi's 500 steps cost ten times as much and gain little: energy distances of 0.170, 0.178 and 0.162
# with 50, 100 and 500 steps, over 30 readings of 035_power_drill on a 5×16 cylinder
NPSE_STEPS = 50


class Rival:
    """A proposal that samples from an estimator of sbi, without rejection."""

    def __init__(
        self, name: str, posterior: Any, view: AnyView, scale: tuple[Tensor, Tensor]
    ) -> None:
        self.name = name
        self._posterior, self._view = posterior, view
        self._mean, self._scale = scale
        self._options = {"steps": NPSE_STEPS} if name == "npse" else {}

    def propose(self, z: Floats, live: Bools, n: int, rng: np.random.Generator) -> Poses:
        reading, alive = torch.from_numpy(z).float()[None], torch.from_numpy(live).float()[None]
        seen, angle = self._view(reading, alive)
        with _quiet(int(rng.integers(2**63))), torch.no_grad():
            theta = self._posterior.sample(
                (n,), x=seen, show_progress_bars=False, reject_outside_prior=False, **self._options
            )
        poses = rotated(theta * self._scale + self._mean, angle).numpy().astype(np.float64)
        x, y, c, s = poses.T
        return np.column_stack([x, y, np.arctan2(s, c)])


def train_rival(
    name: str, model: ObservationModel, noise: Noise, *, seed: int = 0,
    contacts: int | None = None, max_epochs: int | None = None,
) -> Proposal:  # fmt: skip
    """A rival, trained until sbi stops it early; contacts and epochs are its own if None.

    Raises:
        SetupError: there is no such rival, sbi is not installed, or the skin misses the object.
    """
    if name not in RIVALS:
        raise SetupError(f"'{name}' is no rival; use one of {', '.join(RIVALS)}")
    kind, (own_contacts, own_epochs) = name.partition("-")[0], RIVALS[name]
    contacts = contacts or own_contacts
    touches = simulate(model, contacts, np.random.default_rng(seed))
    frame, view = PoseFrame(), views.best(model.layout)
    coordinates = frame.encode(touches.pose)
    batches = Batches(touches, coordinates, model.leak, noise, seed, torch.device("cpu"))
    z, live, _ = batches.read(torch.arange(contacts))
    seen, angle = view(z, live)
    poses = frame.features(frame.turned(coordinates, angle))
    mean, scale = standard(poses)
    with _quiet(seed):
        trainer = _trainer(kind)
        trainer.append_simulations((poses - mean) / scale, seen)
        estimator = trainer.train(max_num_epochs=max_epochs or own_epochs)
        with_ = {"npe": "direct", "npse": "sde", "fmpe": "ode"}[kind]
        posterior = trainer.build_posterior(estimator, sample_with=with_)
    return Rival(kind, posterior, view, (mean, scale))


def _trainer(kind: str) -> Any:
    """sbi's trainer of `kind`; its prior is the distribution of the contacts."""
    try:
        from sbi import inference, neural_nets  # noqa: PLC0415
    except ImportError:
        raise SetupError(
            f"{kind} comes from sbi, which is not installed; pip install 'taxeld[rivals]'"
        ) from None
    # Activations are 0..1 already; z-scoring amplifies the noise of taxels that are rarely pressed:
    # FMPE's energy distance is 0.090 without and 0.128 with it. The spline flow is better with it.
    options: dict[str, Any] = {"tracker": _Untracked(), "show_progress_bars": False}
    match kind:
        case "npe":
            return inference.NPE(density_estimator=neural_nets.posterior_nn("nsf"), **options)
        case "npse":
            net = neural_nets.posterior_score_nn(z_score_x="none")
            return inference.NPSE(vf_estimator=net, **options)
        case _:
            net = neural_nets.posterior_flow_nn(z_score_x="none")
            return inference.FMPE(vf_estimator=net, **options)


@contextlib.contextmanager
def _quiet(seed: int) -> Iterator[None]:
    """Keep sbi's prints, warnings and draws from torch's global generator from the caller."""
    with (
        torch.random.fork_rng(devices=[]),
        contextlib.redirect_stdout(io.StringIO()),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")
        torch.manual_seed(seed)
        yield


class _Untracked:
    """A tracker of sbi that writes nothing; sbi's own makes a folder of TensorBoard logs."""

    log_dir = None

    def log_metric(self, name: str, value: float, step: int | None = None) -> None: ...

    def log_metrics(self, metrics: dict[str, float], step: int | None = None) -> None: ...

    def log_params(self, params: dict[str, Any]) -> None: ...

    def add_figure(self, name: str, figure: Any, step: int | None = None) -> None: ...

    def flush(self) -> None: ...
