"""Training of the denoiser: MSE on v, an exponential average of the weights, cosine decay."""

import copy
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import nn

from taxeld_training.dataset import Batches
from taxeld_training.diffusion import Denoiser, NetworkConfig


@dataclass(frozen=True)
class TrainConfig:
    """What it takes to repeat a training; saved inside the ONNX file."""

    contacts: int = 300_000  # simulated once; noise, gain and dead taxels are drawn anew each batch
    batch: int = 512  # readings an update
    repeats: int = 4  # noise levels each is denoised at: the taxels' encoder is then paid once
    updates: int = 10_000
    learning_rate: float = 2e-3
    average: float = 0.999  # decay of the exponential average of the weights
    seed: int = 0


def train(
    network: NetworkConfig,
    config: TrainConfig,
    batches: Batches,
    progress: Callable[[int, float], None],
) -> Denoiser:
    """The averaged denoiser after `config.updates` updates; `progress` hears (updates, loss)."""
    torch.manual_seed(config.seed)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    net = Denoiser(network)
    net.mean.copy_(batches.mean)
    net.scale.copy_(batches.scale)
    net.to(device)
    averaged = copy.deepcopy(net)
    optimizer = torch.optim.AdamW(
        net.parameters(), lr=config.learning_rate, weight_decay=1e-4, fused=True
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
    mean_loss = 1.0
    for update in range(1, config.updates + 1):
        loss = _loss(net, batches, config, device)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        decay = min(config.average, update / (update + 10.0))
        with torch.no_grad():
            torch._foreach_lerp_(list(averaged.parameters()), list(net.parameters()), 1.0 - decay)
        if update % 50 == 0:
            mean_loss += 0.1 * (loss.item() - mean_loss)
            progress(update, mean_loss)
    return averaged.cpu().eval()


def _loss(
    net: Denoiser, batches: Batches, config: TrainConfig, device: torch.device
) -> torch.Tensor:
    z, live, pose = (a.to(device) for a in batches.draw(config.batch))
    n = config.batch * config.repeats
    clean = ((pose - net.mean) / net.scale).repeat(config.repeats, 1)
    context = net.encode(z, live).repeat(config.repeats, 1)
    # one t a row, stratified over the batch: less variance at no cost
    t = (torch.randperm(n, device=device) * net.config.steps) // n
    alpha_bar = net.alpha_bar[t, None]
    noise = torch.randn_like(clean)
    noisy = alpha_bar.sqrt() * clean + (1.0 - alpha_bar).sqrt() * noise
    target = alpha_bar.sqrt() * noise - (1.0 - alpha_bar).sqrt() * clean
    return nn.functional.mse_loss(net(noisy, context + net.time(t)), target)
