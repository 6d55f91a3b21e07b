"""What a soft skin reads of a press that is over: it only fades."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from taxeld.arrays import Floats, Poses
from taxeld.layout import read as layouts
from taxeld_hil.scenario.mesh_config import SKINS
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.world.mesh_physics import MeshPhysics

SKIN = layouts.load(Scenario("box").layout)
FULL = np.full(len(SKIN), 20_000.0)
AWAY_STEPS = 60
ROUNDING = 1e-6  # counts


class GivenDepths:
    """Depths [m] that are given, in place of a solid's: that of a pose is its x."""

    def __init__(self, depth_m: Floats) -> None:
        self.depth_m = depth_m  # (steps, M)

    def indentation(self, seen: Poses, _sag_m: Floats) -> Floats:
        step = int(seen[0])
        return self.depth_m[step] if step < len(self.depth_m) else np.zeros(len(SKIN))


@pytest.mark.parametrize("name", SKINS)
@given(
    seed=st.integers(0, 2**32),
    taxels=st.lists(st.integers(0, len(SKIN) - 1), min_size=1, max_size=12, unique=True),
    steps=st.integers(1, 40),
    pressed=st.floats(0.05, 1.0),
    period_s=st.floats(0.01, 2.0),
)
@settings(max_examples=60, deadline=None)
def test_while_nothing_is_touched_no_reading_rises(
    name: str, seed: int, taxels: list[int], steps: int, pressed: float, period_s: float
) -> None:
    """Presses of any depth, on and off, on any taxels; then nothing. Foam keeps of each press its
    own share, and cross-talk couples what is kept: together they fade, on every taxel."""
    rng = np.random.default_rng(seed)
    depth_m = np.zeros((steps, len(SKIN)))
    on = rng.random((steps, len(taxels))) < pressed
    depth_m[:, taxels] = np.where(on, rng.uniform(0.0, 0.006, on.shape), 0.0)
    physics = MeshPhysics(SKINS[name], GivenDepths(depth_m), SKIN, 0.005, FULL, rng)  # type: ignore[arg-type]
    counts = np.array([
        physics.press(np.array([k, 0.0, 0.0]), period_s * k) for k in range(steps + AWAY_STEPS)
    ])  # fmt: skip
    assert (np.diff(counts[steps:], axis=0) <= ROUNDING).all()
    assert counts.min() >= 0.0
