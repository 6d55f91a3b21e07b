"""Where a scan was made is known only as well as its time and the poses about it: an estimate from
places that are badly known is less sure, never wrong."""

from collections.abc import Iterator

import numpy as np
import pytest

from taxeld.estimator.estimate import Status
from taxeld.model import se2
from taxeld.model.symmetry import add_m
from taxeld.pipeline.freshness import Why
from taxeld.pipeline.pipeline import Outcome, Pipeline
from taxeld.pipeline.poses import EXTRAPOLATE_S
from taxeld.proposals.bundle import Bundle
from taxeld_protocol.decoder import Scan
from tests.rig.simulated_skin import SimulatedSkin
from tests.rig.skins import SKIN

from .test_pipeline import CAN, ROBOT, START_S, TRUTH, pipeline_of

RADIUS_M = SKIN.radius_m
SLCAN = 'kind = "can"\ninterface = "slcan"\nchannel = "/dev/ttyACM0"'
SERIAL = 'kind = "serial"\nchannel = "/dev/ttyUSB0"'
EVERY = 9  # of so many poses one arrives
FAST_M_S = 0.25
AFTER_S = 0.003  # of a pose, until a scan


def placed(box: Bundle, source: str = CAN) -> Pipeline:
    return pipeline_of(box, ROBOT, EXTRAPOLATE_S, source)


class Sweep:
    """A robot that goes past a box as fast as it travels, and always along y while it touches: what
    is placed too late is placed too low, each time."""

    def __init__(self, box: Bundle) -> None:
        (left, low), (right, high) = box.model.scene.outline.min(0), box.model.scene.outline.max(0)
        sides = (right + RADIUS_M - 0.003, left - RADIUS_M + 0.003)
        end, far = low - RADIUS_M + 0.004, 0.25
        way = [(far, -far)]
        for x in (0.0, 0.02):  # two bumps
            way += [(x, -far), (x, end), (x, -far)]
        for x, clear in zip(sides, (far, -far), strict=True):  # two slides
            way += [(x, low - 0.07), (x, high + 0.07), (clear, far), (clear, -far)]
        way += [(-0.02, -far), (-0.02, end), (-0.02, -far)]
        self.way = np.array(way)
        leg_s = np.hypot(*np.diff(self.way, axis=0).T) / FAST_M_S
        self.t = 1.5 + np.append(0.0, leg_s.cumsum())  # at rest until the skin is known
        self.model, self.skin = box.model, SimulatedSkin(SKIN, noise=5.0)

    def sensor(self, t: float) -> se2.Poses:
        """Its true pose (3,)."""
        x, y = (np.interp(t, self.t, column) for column in self.way.T)
        return se2.compose(TRUTH, np.array([x, y, 0.1]))

    def scan(self, t: float) -> Scan:
        seen = se2.compose(se2.inverse(self.sensor(t)), TRUTH)
        self.skin.press = 20_000.0 * self.model.activation(seen[None])[0]
        self.skin.t = START_S + t - 0.05
        return self.skin.scan()

    def felt_by(self, pipeline: Pipeline, every: int, first: int = 0) -> Iterator[Outcome]:
        """What a daemon makes of it that gets one of `every` poses, of 100 a second."""
        for k in range(round(100.0 * self.t[-1])):
            t = 0.01 * k
            if k % every == first:
                pipeline.poses.add(START_S + t, *self.sensor(t).tolist())
            scans = [self.scan(t - 0.01 + AFTER_S)] if k % 5 == 4 else []
            yield from pipeline.advance(scans, START_S + t + 0.001)


def misleads(box: Bundle, outcome: Outcome) -> bool:
    """Whether an estimate is sure, and 10 mm off or beyond its own radius."""
    found = outcome.estimate
    error_m = add_m(box.model.scene, found.map, TRUTH)[1]
    return is_sure(outcome) and error_m > min(found.radius_m, 0.01)


def is_sure(outcome: Outcome) -> bool:
    return outcome.estimate.status is Status.CONVERGED


def test_with_one_pose_of_nine_estimates_are_right_and_less_sure(box: Bundle) -> None:
    whole = list(Sweep(box).felt_by(placed(box), every=1))
    assert not any(misleads(box, outcome) for outcome in whole)
    for first in range(0, EVERY, 2):
        thin = list(Sweep(box).felt_by(placed(box), EVERY, first))
        assert not any(misleads(box, outcome) for outcome in thin)
        assert add_m(box.model.scene, thin[-1].estimate.map, TRUTH)[1] < 0.01
        assert sum(map(is_sure, thin)) < sum(map(is_sure, whole))


def why_not(box: Bundle, m_s: float, age_s: float, source: str = CAN, late_s: float = 0.0) -> Why:
    """Why the last scan is of no use to a skin that moves, whose poses are of `age_s` before each
    scan, where that scan was read late."""
    pipeline, skin = placed(box, source), SimulatedSkin(SKIN, noise=5.0)
    for k in range(24):
        skin.t += late_s * (k == 23)
        scan = skin.scan()
        pose_t = scan.t - age_s
        pipeline.poses.add(pose_t, m_s * (pose_t - 100.0), 0.0, 0.0)
        list(pipeline.advance([scan], scan.t))
        list(pipeline.advance([], scan.t + 0.03))
    why = pipeline.freshness.why(pipeline.estimate)
    assert (pipeline.inputs.scans_without_pose > 0) == (why is Why.NO_POSE)
    return why


@pytest.mark.parametrize(
    ("m_s", "age_s", "why"),
    [(0.0, 0.045, Why.UNTOUCHED), (0.2, 0.045, Why.UNTOUCHED), (0.25, 0.045, Why.NO_POSE)],
)
def test_a_pose_that_is_too_old_for_the_speed_is_none(
    box: Bundle, m_s: float, age_s: float, why: Why
) -> None:
    """A link may go as far meanwhile as an estimate may be off, `filter.within_m`."""
    assert why_not(box, m_s, age_s) is why


@pytest.mark.parametrize("source", [SLCAN, SERIAL])
def test_a_scan_without_a_stamp_is_placed_no_nearer_than_it_was_read_late(
    box: Bundle, source: str
) -> None:
    assert why_not(box, 0.5, 0.005, source) is Why.UNTOUCHED
    assert why_not(box, 0.0, 0.005, source, late_s=0.06) is Why.UNTOUCHED
    assert why_not(box, 0.5, 0.005, source, late_s=0.06) is Why.NO_POSE
    assert why_not(box, 0.5, 0.005, CAN, late_s=0.06) is Why.UNTOUCHED
