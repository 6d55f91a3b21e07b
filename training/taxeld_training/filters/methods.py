"""Filters by their parts, as the daemon's configuration has them, and the result of a touch.

What a method does not name is the configuration that ships, its model of a reading's errors above
all: a trial's own noise is a condition of its world, and no filter knows it.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from taxeld.config.tables import FilterConfig
from taxeld.estimator.estimate import Hypotheses, Status
from taxeld.estimator.scans import noise_of
from taxeld_hil import integrity
from taxeld_hil.integrity import Claims

GRID = "grid"  # `proposal` of the grid filter
NOISE = noise_of(FilterConfig())  # the grid filter's noise as well


@dataclass(frozen=True)
class Method:
    """A filter by its parts."""

    proposal: str  # GRID is the limit: it has neither injection nor particles
    injection: str = ""
    particles: int = 0
    particles_max: int = 0  # 0: as many as `particles`
    samples: int = -1  # that a touch brings; negative: half as many as `particles`
    touches: tuple[int, ...] = ()  # the grid looks at its belief after these; none: after each

    @property
    def injected(self) -> int:
        """Samples that a touch brings."""
        return self.particles // 2 if self.samples < 0 else self.samples

    @property
    def is_shipped(self) -> bool:
        """Whether it is the daemon's own choice, but for the proposal."""
        one = self.injection, self.particles, self.particles_max, self.injected
        return one == (
            SHIPPED.injection,
            SHIPPED.particles,
            SHIPPED.particles_max,
            SHIPPED.injected,
        )

    def config(self, seed: int, motion: str = FilterConfig().motion) -> FilterConfig:
        """The daemon's configuration with these parts."""
        return FilterConfig(
            particles=self.particles,
            particles_max=self.particles_max or self.particles,
            injected=self.injected,
            injection=self.injection,
            motion=motion,
            seed=seed,
        )


_DEFAULT = FilterConfig()
SHIPPED = Method(
    "density", _DEFAULT.injection, _DEFAULT.particles, _DEFAULT.particles_max
)  # the daemon's own choice, with a shipped bundle and no configuration


TABLED = replace(SHIPPED, proposal="table")  # nothing is trained for it


class TouchResult(NamedTuple):
    """A filter's estimate after a touch; None or nan where the grid filter has nothing to say."""

    # Symmetric ADD of the heaviest mode, to the nearer object if there are two of a kind. It is nan
    # where there is no estimate, and where that is of another object than the one touched.
    map_mm: float
    status: Status | None
    particles: int
    p: float = math.nan
    radius_m: float = math.nan
    hypotheses: Hypotheses = Hypotheses(math.nan, math.nan, math.nan)
    cpu_ms: float = math.nan  # processor time of the filter for all scans of the touch
    idle_ms: float = math.nan  # and for a second of scans that tell nothing
    object: int = 0  # number of the object that the estimate is of
    objects: Sequence[float] = ()  # probabilities of the known objects
    guide_ms: float = 0.0  # processor time of the advice before this touch

    @property
    def radius_mm(self) -> float:
        return 1e3 * self.radius_m

    @property
    def found(self) -> bool:
        return bool(integrity.is_found(self.map_mm))

    @property
    def sure(self) -> bool:
        return bool(integrity.is_sure(self.p))


def claims(trials: Iterable[Sequence[TouchResult]]) -> Claims:
    """The estimates of N trials after T touches each (N, T)."""
    each = [[(one.p, one.radius_mm, one.map_mm) for one in trial] for trial in trials]
    return Claims(*np.moveaxis(np.array(each), -1, 0))
