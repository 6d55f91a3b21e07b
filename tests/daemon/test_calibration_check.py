"""Touches are held against the calibration: what is wrong is named, and what is right is not."""

import numpy as np
import pytest

from taxeld.arrays import Floats, Poses
from taxeld.config.tables import FilterConfig
from taxeld.model import se2
from taxeld.model.noise import FLOOR
from taxeld.model.observation import Observation
from taxeld.model.symmetry import Mode
from taxeld.pipeline.calibration_check import (
    LEAST_TOUCHES,
    CalibrationCheck,
    CalibrationDoubt,
    Suspect,
)
from taxeld.proposals import bundle
from tests.hil.rig import PLACED, PressedSkin
from tests.rig.skins import SKIN

MODEL = bundle.load("box", SKIN, 0.005).model
GAIN_CV, SIGMA = 0.15, 0.03


class Touching:
    """A skin with gains of its own that touches, and a belief that is right of the object."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.gain = 1.0 + GAIN_CV * self.rng.standard_normal(len(SKIN))
        self.check = CalibrationCheck(MODEL, FilterConfig())
        self.sensor = PressedSkin.drawn(MODEL, seed, presses=16).sensor
        self.order = np.arange(len(SKIN))
        self.contacts = 0
        self.placed = self.believed = PLACED
        self.leaks = False  # whether presses are read beside them, and told apart as by the intake

    def touch(self, factor: float = 1.0, mount: Poses = se2.IDENTITY) -> None:
        """The next touch, and the scans after it; the daemon believes in a mount of zero."""
        sensor = self.sensor[self.contacts]
        self.contacts += 1
        h = MODEL.activation(se2.compose(se2.inverse(sensor), self.placed)[None])[0]
        noise = SIGMA * self.rng.standard_normal(len(h))
        read = np.where(h > 0.0, factor * self.gain * h + noise, 0.0)
        if self.leaks:
            share = self.rng.uniform(0.5, 1.5, len(h))
            read = read + share * MODEL.leak.of(np.maximum(read, 0.0))
        z = np.clip(read, 0.0, 1.0)[self.order]
        z = np.where(z < FLOOR, 0.0, z)
        told = se2.compose(sensor, se2.inverse(mount))
        live = np.ones(len(z), dtype=bool)
        evidence = MODEL.leak.without(z, FLOOR) if self.leaks else (z,)
        self.scan(Observation(told, evidence[0], live, *evidence[1:]))

    def scan(self, used: Observation) -> None:
        """Take the scan, and all steps that follow it."""
        modes = [Mode(self.believed, 1.0, np.arange(1))]
        self.check.on_scan(used, modes, self.contacts)
        while self.check.is_due:
            self.check.on_scan(None, modes, self.contacts)
            self.check.step()

    def touches(self, n: int, **wrong: object) -> Suspect:
        """What is suspected first in n touches."""
        for _ in range(n):
            self.touch(**wrong)  # type: ignore[arg-type]
            if self.check.doubt.suspect is not Suspect.NONE:
                return self.check.doubt.suspect
        return Suspect.NONE


@pytest.mark.parametrize(
    ("seed", "leaks"), [*((seed, False) for seed in range(6)), *((seed, True) for seed in range(3))]
)
def test_a_right_skin_is_never_doubted(seed: int, leaks: bool) -> None:
    """Nor one on which presses are read beside them as well."""
    touching = Touching(seed)
    touching.leaks = leaks
    assert touching.touches(16) is Suspect.NONE
    assert touching.check.doubt != CalibrationDoubt(), "it was judged"


@pytest.mark.parametrize(("factor", "leaks"), [(2.5, False), (1 / 2.5, False), (2.5, True)])
def test_a_full_scale_that_is_wrong_by_two_and_a_half_is_noticed_within_eight_touches(
    factor: float, leaks: bool
) -> None:
    for seed in range(3):
        touching = Touching(seed)
        touching.leaks = leaks
        assert touching.touches(8, factor=factor) is Suspect.SCALE
        assert leaks or touching.check.doubt.scale == pytest.approx(factor, rel=0.35)


@pytest.mark.parametrize(
    "mount", [np.array([0.004, 0.0, 0.0]), np.array([0.0, 0.0, np.radians(4.0)])]
)
def test_a_mount_that_is_off_is_noticed(mount: Floats) -> None:
    for seed in range(3):
        touching = Touching(seed)
        assert touching.touches(16, mount=mount) is Suspect.MOUNT


def test_modules_that_have_changed_places_are_noticed() -> None:
    module = np.unique(SKIN.uid >> 4, return_inverse=True)[1]
    touching = Touching(1)
    at, there = np.flatnonzero(module == 2), np.flatnonzero(module == 3)
    touching.order[at], touching.order[there] = there, at
    assert touching.touches(16) is Suspect.MODULES


def test_one_touch_of_nothing_raises_no_doubt() -> None:
    touching = Touching(2)
    touching.touches(6)
    ghost = np.where(np.arange(len(SKIN)) % 16 < 3, 0.6, 0.0)
    touching.contacts += 1
    touching.scan(Observation(np.array([0.4, 0.3, 0.1]), ghost, np.ones(len(SKIN), dtype=bool)))
    assert touching.check.doubt.suspect is Suspect.NONE
    assert touching.touches(6) is Suspect.NONE


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("shift", [(0.06, -0.05, 0.0), (0.008, 0.005, 0.0)], ids=["far", "near"])
def test_an_object_that_was_moved_is_no_wrong_calibration(
    seed: int, shift: tuple[float, float, float]
) -> None:
    touching = Touching(seed)
    assert touching.touches(6) is Suspect.NONE
    touching.placed = PLACED + np.array(shift)
    touching.sensor = touching.sensor + np.array(shift)
    assert touching.touches(2) is Suspect.NONE  # the belief has not followed yet
    touching.believed = touching.placed
    assert touching.touches(8) is Suspect.NONE


def test_a_reset_forgets_touches_and_leaves_the_doubt_until_others_are_judged() -> None:
    touching = Touching(0)
    assert touching.touches(8, factor=2.5) is Suspect.SCALE
    doubt = touching.check.doubt
    touching.check.reset()
    for _ in range(LEAST_TOUCHES - 1):
        touching.touch()
    assert touching.check.doubt is doubt
    touching.touch()
    assert touching.check.doubt.suspect is Suspect.NONE


def test_an_object_that_gives_way_is_not_judged_by() -> None:
    touching = Touching(0)
    touching.check = CalibrationCheck(MODEL, FilterConfig(motion="push"))
    assert touching.touches(12, factor=2.5) is Suspect.NONE
