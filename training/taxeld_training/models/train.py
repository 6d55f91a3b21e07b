"""Training of any model: AdamW, cosine decay, an exponential average of the weights."""

import copy
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from torch import Tensor, nn

from taxeld.model.leak import Leak
from taxeld.model.noise import Noise
from taxeld_training.models.base import Model
from taxeld_training.models.dataset import Batches, SimulatedTouches

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


AnyModel = TypeVar("AnyModel", bound=Model)


def train_beside(
    given: Sequence[tuple[Callable[[], AnyModel], TrainConfig]],
    touches: SimulatedTouches,
    leak: Leak,
    noise: Noise,
    progress: Callable[[float], None] = lambda _: None,
) -> list[AnyModel]:
    """Averaged models after `updates` updates of each configuration, on readings as a filter sees
    them. All have one view, one frame and `shared` configurations: a batch is drawn and looked at
    once for all of them, on a second core while they learn from the one before."""
    runs = [_Run(*one) for one in given]
    config = given[0][1]
    coordinates = runs[0].model.frame.encode(touches.pose)
    batches = Batches(touches, coordinates, leak, noise, config.seed, runs[0].device)
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


def shared(config: TrainConfig) -> tuple[int, int, int]:
    """The settings on which the batches of a configuration depend."""
    return config.contacts, config.batch, config.seed


class _Run(Generic[AnyModel]):
    """A model on its way. It draws from torch's generator as if it were the only one."""

    def __init__(self, make: Callable[[], AnyModel], config: TrainConfig) -> None:
        torch.manual_seed(config.seed)
        self.config = config
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self.model = make().to(self.device)
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
