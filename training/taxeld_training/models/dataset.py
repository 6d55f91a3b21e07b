"""Simulated touches: contact poses with their true activations, and readings of them as a filter
sees them: 0 under a floor, and 0 where presses beside a taxel may explain what it reads."""

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from taxeld.config.tables import FilterConfig
from taxeld.errors import SetupError
from taxeld.estimator.scans import noise_of
from taxeld.model.contacts import synthesise
from taxeld.model.leak import Leak
from taxeld.model.noise import FLOOR, Noise
from taxeld.model.observation import Observation, ObservationModel

MIN_ACTIVATION = 0.05  # least of the strongest taxel: weaker contacts are not learned or sampled
SILENT = 5.0  # standard deviations of noise under which a reading is 0: noise is no touch
FLOOR_MAX = 0.12  # a skin's floor is anything from FLOOR to this: skins and places differ
IN_USE = noise_of(FilterConfig())  # the filter's: samplers learn it and are measured by it
DEAD_SHARE = 0.3  # share of training touches with dead taxels
DEAD_MAX = 0.3  # largest share of a skin's taxels that is dead
# All that readings of a training depart by, which a bundle and its samplers name
LEARNED = {
    **asdict(IN_USE),
    "floor": FLOOR,
    "floor_max": FLOOR_MAX,
    "silent": SILENT,
    "dead_share": DEAD_SHARE,
    "dead_max": DEAD_MAX,
}


@dataclass(frozen=True)
class SimulatedTouches:
    """n contacts: poses (n, 3) in the sensor frame, activations h (n, M) without noise."""

    pose: NDArray[np.float64]
    activation: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.pose)


def simulate(
    model: ObservationModel,
    n: int,
    rng: np.random.Generator,
    progress: Callable[[float], None] = lambda _: None,
) -> SimulatedTouches:
    """`n` contacts under the prior of single-step projection, each with a taxel over
    MIN_ACTIVATION. `progress` is called with the share that is done.

    Raises:
        SetupError: hardly any contact presses a taxel.
    """
    poses, activations = [], []
    kept = drawn = 0
    while kept < n:
        contacts = synthesise(model.scene, model.layout.radius_m, model.depth_max_m, 20_000, rng)
        h = model.activation(contacts.pose)
        keep = h.max(axis=1) > MIN_ACTIVATION
        poses.append(contacts.pose[keep])
        activations.append(h[keep].astype(np.float32))
        kept, drawn = kept + int(keep.sum()), drawn + 20_000
        progress(min(kept / n, 1.0))
        if drawn >= 400_000 and kept < drawn // 100:
            raise SetupError(
                "fewer than 1 % of simulated contacts press a taxel: the skin hardly reaches the "
                "object; look at 'taxeld-train scene OBJECT --png', and change --height-m"
            )
    return SimulatedTouches(np.concatenate(poses)[:n], np.concatenate(activations)[:n])


class SkinReader:
    """Reads true activations as a filter sees them.

    A taxel that is pressed reads the activation times its gain, and departs from that by the
    filter's noise, or does not answer; one that is not has the skin's own noise, far under its
    floor. Either reads as well what presses beside it leave there, of the size of the `Leak`'s
    bound. The skin reports 0 under its floor, and the filter takes a reading under the bound for 0.
    """

    def __init__(self, leak: Leak, noise: Noise, seed: int, device: torch.device) -> None:
        self.generator = torch.Generator(device).manual_seed(seed)
        self._leak, self._gain_cv = leak, float(noise.gain_cv)
        self._answers = float(noise.answers)
        self._sigma = torch.tensor(float(noise.sigma), device=device)

    def read(self, h: Tensor, live: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Activations h (n, M), live (n, M) as 0 or 1 → readings, floors and residues (n, M)."""
        floor = self._floor(h * live)
        own = torch.clamp(floor / SILENT, max=float(self._sigma))
        sd = torch.where(h > 0.0, torch.hypot(self._sigma, self._gain_cv * h), own)
        z = h + sd * self._normal(h)  # one deviation for gain and noise
        leak = self._leak.drawn((z * live).clamp(0.0, 1.0).cpu().numpy())
        z = ((z + torch.from_numpy(leak).to(z) * self._normal(h)) * live).clamp(0.0, 1.0)
        z = z * (torch.rand(z.shape, generator=self.generator, device=z.device) < self._answers)
        floor = _felt(z, floor)
        z = torch.where(z >= floor, z, 0.0)
        seen = self._leak.without(z.cpu().numpy(), floor.cpu().numpy())
        z, floor, residue = (torch.from_numpy(part).to(z) for part in seen)
        return z, floor, residue

    def _floor(self, h: Tensor) -> Tensor:
        """(n, 1) of each reading, such that the press is over it."""
        g = self.generator
        share = torch.rand((len(h), 1), generator=g, dtype=h.dtype, device=h.device)
        return _felt(h, share * (FLOOR_MAX - FLOOR) + FLOOR)

    def _normal(self, like: Tensor) -> Tensor:
        g = self.generator
        return torch.randn(like.shape, generator=g, dtype=like.dtype, device=like.device)


def _felt(z: Tensor, floor: Tensor) -> Tensor:
    """Floors (n, 1); the least of all where nothing of z (n, M) would be felt."""
    return torch.where(z.amax(dim=1, keepdim=True) >= floor, floor, FLOOR)


@dataclass(frozen=True)
class SimulatedReadings:
    """n readings: z, live, floor and residue (n, M)."""

    z: NDArray[np.float64]
    live: NDArray[np.bool_]
    floor: NDArray[np.float64]
    residue: NDArray[np.float64]

    def __iter__(self) -> Iterator[Observation]:
        """Each as evidence, by a sensor at the origin."""
        for each in zip(self.z, self.live, self.floor, self.residue, strict=True):
            yield Observation(np.zeros(3), *each)


def read(
    model: ObservationModel, noise: Noise, n: int, rng: np.random.Generator, dead: float = 0.0
) -> SimulatedReadings:
    """`n` simulated contacts as a filter sees them: each is felt by a live taxel at least. A share
    `dead` of the taxels is dead in each."""
    skin = SkinReader(model.leak, noise, int(rng.integers(2**63)), torch.device("cpu"))
    found, parts = 0, []
    while found < n:
        touches = simulate(model, n, rng)
        live = rng.random(touches.activation.shape) >= dead
        seen = skin.read(torch.from_numpy(touches.activation).double(), torch.from_numpy(live))
        z, floor, residue = (part.numpy() for part in seen)
        felt = z.any(axis=1)
        found += int(felt.sum())
        parts.append(tuple(part[felt] for part in (z, live, floor, residue)))
    return SimulatedReadings(*(np.concatenate(part)[:n] for part in zip(*parts, strict=True)))


class Batches:
    """Batches of noisy readings with the coordinates of their poses, drawn with replacement."""

    def __init__(
        self,
        touches: SimulatedTouches,
        coordinates: Tensor,
        leak: Leak,
        noise: Noise,
        seed: int,
        device: torch.device,
    ) -> None:
        self.activation = torch.from_numpy(touches.activation).to(device)
        self.coordinates = coordinates.to(device)  # (n, 3) coordinates of touches.pose
        self._skin = SkinReader(leak, noise, seed, device)
        self._generator = self._skin.generator

    def draw(self, n: int) -> tuple[Tensor, Tensor, Tensor]:
        """z (n, M), live (n, M) and coordinates (n, 3)."""
        g, device = self._generator, self.activation.device
        i = torch.randint(len(self.coordinates), (n,), generator=g, device=device)
        h = self.activation[i]
        live = self._live(h)
        z, _, _ = self._skin.read(h, live)
        return z, live, self.coordinates[i]

    def _live(self, h: Tensor) -> Tensor:
        """live (n, M): dead taxels in DEAD_SHARE of the touches, uniformly 0..DEAD_MAX of the skin;
        none where no live taxel would be pressed."""
        g, device = self._generator, h.device
        share = torch.rand((len(h), 1), generator=g, device=device) * (DEAD_MAX / DEAD_SHARE)
        share = (share - (DEAD_MAX / DEAD_SHARE - DEAD_MAX)).clamp(min=0.0)
        live = (torch.rand(h.shape, generator=g, device=device) >= share).float()
        silent = (h * live).amax(dim=1, keepdim=True) < MIN_ACTIVATION
        return torch.where(silent, 1.0, live)
