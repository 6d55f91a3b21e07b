"""The work of a scan is bounded, whatever the configuration."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from taxeld.arrays import Bools, Floats, Grid, Poses
from taxeld.config.tables import FilterConfig
from taxeld.estimator import memory
from taxeld.estimator.bank import FOLLOWED, Known
from taxeld.estimator.estimator import Estimator
from taxeld.estimator.object_belief import SEARCHED
from taxeld.estimator.scans import Field
from taxeld.model import se2
from taxeld.model.observation import Activation, ObservationModel
from tests.rig.examples import examples
from tests.rig.pressed_box import TRUTH, Knowing, World, box_side

# Poses that a scan and its search may have explained, in N at most + S × the contacts of a search
WORK = 16
TOUCHES = 6


class Counted(Knowing):
    """Counts the poses that it draws near the truth, and those that are to be explained, of which
    those near the truth explain every contact."""

    def __init__(self, world: World) -> None:
        super().__init__(world)
        self.drawn: list[int] = []
        self.explained = 0

    def propose(self, z: Floats, live: Bools, n: int, rng: np.random.Generator) -> Poses:
        self.drawn.append(n)
        return super().propose(z, live, n, rng)

    def column(self, fields: Grid) -> Grid:
        return fields

    def of(self, columns: Sequence[Grid], *_: Any) -> Callable[[Poses], Floats]:
        silent = [column[Field.SILENT].sum(dtype=np.float64) for column in columns]
        untouched = np.array(silent)
        likely = np.where(untouched < -1.0, 20.0 - untouched, 0.0)

        def explain(poses: Poses) -> Floats:
            self.explained += len(poses)
            apart = (poses - TRUTH) / (0.005, 0.005, 0.05)
            return np.maximum(likely - 0.5 * np.square(apart).sum(axis=1)[:, None], 0.0)

        return explain


def log_uniform(least: int, most: int) -> st.SearchStrategy[int]:
    """Small and large numbers alike."""
    octaves = st.floats(np.log2(least), np.log2(most + 1))
    return octaves.map(lambda u: min(int(2.0**u), most))


configurations = st.builds(
    FilterConfig,
    particles=log_uniform(2, 100_000),
    particles_max=log_uniform(2, 100_000),
    injected=st.just(0) | log_uniform(1, 10_000),
    motion=st.sampled_from(["none", "push"]),
    nudge_m=st.sampled_from([0.0, 0.001]),
    half_width_m=st.sampled_from([0.1, 100.0]),
    seed=st.integers(0, 9),
)


@pytest.mark.parametrize("objects", [1, 4])
@examples(5)
@given(configurations)
@example(FilterConfig(particles=100, injected=100))
@example(FilterConfig(particles=25))
@example(FilterConfig(injected=400))
@example(FilterConfig(particles=2, particles_max=60_000, injected=18, motion="push"))
def test_a_scan_with_its_search_has_a_bounded_number_of_poses_explained(
    box_model: ObservationModel,
    objects: int,
    config: FilterConfig,
) -> None:
    world = World(box_model)
    counted = Counted(world)
    more = [Known(box_model, counted)] * (objects - 1)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(memory, "explainer", lambda *_: counted)
        subject = Estimator(box_model, counted, config, more=more)
    size, samples = max(config.particles, config.particles_max), config.injected

    def bounded(step: Callable[..., Any], *given: Any) -> list[int]:
        """→ the samples drawn of each contact by a step."""
        counted.drawn, counted.explained = [], 0
        step(*given)
        assert sum(counted.drawn) <= (FOLLOWED + SEARCHED) * max(samples, size)
        assert counted.explained <= WORK * (size + samples * SEARCHED)
        return counted.drawn

    def pass_over(scan: Activation) -> None:
        subject.on_scan(scan, world.sensor, thinks=False)
        subject.think()

    for k in range(TOUCHES):
        for deep_m in (-0.02, 0.002, 0.003, -0.02, -0.02):
            at = box_side(box_model, 0.2 + 1.35 * k, deep_m)
            world.sensor = se2.compose(TRUTH, at)
            z = box_model.activation(se2.inverse(at)[None])[0]
            world.t += 0.05
            scan = Activation(world.t, z, np.ones(len(z), dtype=bool))
            bounded(pass_over, scan)
            while subject.bank.is_behind:
                bounded(subject.think)
        # whether the belief asks for it or not: each of its contacts has as many samples
        assert len(set(bounded(subject.belief.search))) <= 1
