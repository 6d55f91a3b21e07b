"""Training of any model: AdamW, cosine decay, an exponential average of the weights."""

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import nn

from taxeld.model.leak import Leak
from taxeld.model.observation import Noise
from taxeld_training.models.base import Model
from taxeld_training.models.dataset import Batches, Touches

SCALE_BATCH = 10_000
TELL_UPDATES = 20


@dataclass(frozen=True)
class TrainConfig:
    """What it takes to repeat a training; saved inside the ONNX file."""

    contacts: int = 300_000  # simulated once; noise, gain and dead taxels are drawn anew each batch
    batch: int = 256  # readings an update
    updates: int = 8_000
    learning_rate: float = 2e-3
    average: float = 0.999  # decay of the exponential average of the weights
    seed: int = 0


AnyModel = TypeVar("AnyModel", bound=Model)


def train(
    make: Callable[[], AnyModel], config: TrainConfig, touches: Touches, leak: Leak, noise: Noise,
    progress: Callable[[float], None] = lambda _: None,
) -> AnyModel:  # fmt: skip
    """The averaged model after `config.updates` updates, on readings as a filter sees them.
    `progress` is told which share is done, now and then."""
    torch.manual_seed(config.seed)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    model = make()
    coordinates = model.frame.encode(touches.pose)
    batches = Batches(touches, coordinates, leak, noise, config.seed, device)
    model.to(device)
    with torch.no_grad():
        model.fit_scale(*batches.draw(SCALE_BATCH))
    averaged = copy.deepcopy(model)
    optimizer = torch.optim.AdamW(
        model.parameters(), lr=config.learning_rate, weight_decay=1e-4, fused=True
    )
    warm_up = max(1, config.updates // 50)
    schedule = torch.optim.lr_scheduler.SequentialLR(
        optimizer,
        [
            torch.optim.lr_scheduler.LinearLR(optimizer, 0.05, 1.0, warm_up),
            torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, config.updates - warm_up, 1e-5),
        ],
        [warm_up],
    )
    for update in range(1, config.updates + 1):
        loss = model.loss(*batches.draw(config.batch))
        optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        decay = min(config.average, update / (update + 10.0))
        if update % TELL_UPDATES == 0:
            progress(update / config.updates)
        with torch.no_grad():
            torch._foreach_lerp_(list(averaged.parameters()), list(model.parameters()), 1.0 - decay)
    return averaged.cpu().eval()
