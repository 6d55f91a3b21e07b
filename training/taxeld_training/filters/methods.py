"""Filters by their parts, as the daemon's configuration has them, and what is kept of a touch.

What a method does not name is the configuration that ships, its model of a reading's errors above
all: a trial's own noise is a condition of its world, and no filter knows it.
"""

from dataclasses import dataclass
from typing import NamedTuple

from taxeld.config.tables import FilterConfig
from taxeld.estimator.estimate import Status
from taxeld.estimator.rule import noise_of
from taxeld.model.symmetry import SILENT_MM
from taxeld_training.jobs import fingerprint
from taxeld_training.jobs.rows import SUCCESS_MM

DECIDES = (  # rooms and modules whose code decides the results of a trial
    "taxeld.config.tables",
    "taxeld.model",
    "taxeld.skin.foam",
    "taxeld.proposals",
    "taxeld.estimator",
    "taxeld_hil.scenario.mesh_config",
    "taxeld_hil.world",
    "taxeld_training.models.dataset",
    "taxeld_training.limits",
    "taxeld_training.filters",
)

NOISE = noise_of(FilterConfig())  # the grid filter has it as well


@dataclass(frozen=True)
class Method:
    """A filter by its parts."""

    proposal: str  # GRID: the limit, which has neither injection nor particles
    injection: str = ""
    particles: int = 0
    particles_max: int = 0  # 0: no more than that
    touches: tuple[int, ...] = ()  # after which the grid looks at the belief; none: after each

    @property
    def name(self) -> str:
        size = f"{self.particles}{f'..{self.particles_max}' if self.particles_max else ''}"
        looks = "+".join(map(str, self.touches))
        parts = (self.proposal, self.injection, size, looks and f"after-{looks}")
        return "-".join(part for part in parts if part not in ("0", ""))

    def config(self, seed: int, motion: str = FilterConfig().motion) -> FilterConfig:
        return FilterConfig(
            particles=self.particles,
            particles_max=self.particles_max or self.particles,
            injected=self.particles // 2,
            injection=self.injection,
            motion=motion,
            seed=seed,
        )


_DEFAULT = FilterConfig()
SHIPPED = Method(
    "density", _DEFAULT.injection, _DEFAULT.particles, _DEFAULT.particles_max
)  # the daemon's own choice, with a shipped bundle and no configuration


class TouchResult(NamedTuple):
    """A filter's estimate after a touch; errors are nan where there is none, and where the filter
    assumes another object than the one touched."""

    map_mm: float  # error of the map; to the nearer object, if there are two of a kind
    mean_mm: float
    status: Status | None  # None: the grid filter has none
    particles: int
    meant_mm: float  # error of the map to the object that the trial means

    def scaled(self, unit: float) -> "TouchResult":
        """The same with errors in another unit."""
        return self._replace(
            map_mm=unit * self.map_mm, mean_mm=unit * self.mean_mm, meant_mm=unit * self.meant_mm
        )

    @property
    def succeeded(self) -> bool:
        return self.map_mm < SUCCESS_MM

    @property
    def converged(self) -> bool:
        return self.status is Status.CONVERGED

    @property
    def failed_silently(self) -> bool:
        return self.converged and not self.map_mm <= SILENT_MM


def code() -> str:
    """Hash of the code and the bundles that decide a trial's results: others make another job."""
    return f"{fingerprint.of(*DECIDES)}-{fingerprint.of_bundles()}"
