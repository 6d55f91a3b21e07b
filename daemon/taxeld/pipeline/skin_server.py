"""The pipeline of a skin alone: activations of scans at the sensor's poses, without an object.

The estimate is a placeholder that carries the status of the inputs: it is never published, but
`taxeld status` and the log tell it.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from taxeld.arrays import Bools, Floats, Poses
from taxeld.config.tables import Config
from taxeld.errors import SetupError
from taxeld.estimator.estimate import Estimate, Hypotheses, ProposalKind, Status
from taxeld.estimator.rule import EstimatorCounters
from taxeld.layout.layout import Layout
from taxeld.model import se2
from taxeld.model.activation import Activation
from taxeld.pipeline.advising import Advising
from taxeld.pipeline.calibrated import calibrated
from taxeld.pipeline.calibration_check import CalibrationDoubt
from taxeld.pipeline.freshness import Freshness
from taxeld.pipeline.outcome import Outcome
from taxeld.pipeline.pipeline import SILENT_PERIODS, Pipeline
from taxeld.pipeline.poses import EXTRAPOLATE_S, OnPose
from taxeld.pipeline.stage import SCAN_AGE_S, LinkStage
from taxeld.proposals.ladder import ClockNs, Ladder, Rung, Step, no_clock
from taxeld.skin.calibration import Calibration
from taxeld.told import ToldPose

NOTHING = Estimate(
    t=0.0,
    status=Status.SEARCHING,
    contact=False,
    contacts=0,
    map=se2.IDENTITY,
    mean=se2.IDENTITY,
    cov=np.zeros((3, 3)),
    modes=(),
    p=0.0,
    radius_m=0.0,
    hypotheses=Hypotheses(0.0, 0.0, 1.0),
    object=0,
    objects=(),
    ess=0.0,
    particles=0,
    injected=0,
    proposal=ProposalKind.NONE,
    targets=(),
    log_evidence=0.0,
)


class NoSamples:
    """The proposal of no object."""

    name = "none"

    def propose(self, z: Floats, live: Bools, n: int, rng: np.random.Generator) -> Poses:
        """No poses (0, 3) of activations z (M,) of taxels that are `live` (M,)."""
        del z, live, n, rng
        return np.empty((0, 3))


class SkinServer(Pipeline):
    """Scans and sensor poses in, activations out."""

    def __init__(
        self,
        config: Config,
        layouts: Sequence[Layout],
        clock: ClockNs = no_clock,
        on_pose: OnPose | None = None,
        calibration: Sequence[Calibration | None] = (None,),
        extrapolate_s: float = EXTRAPOLATE_S,
        on_poses: Sequence[OnPose | None] = (),
    ) -> None:
        """As of `Pipeline`, `layouts` and `calibration` of each link; `clock` measures durations
        [ns]."""
        each = [calibrated(config.of_link(k), one) for k, one in enumerate(calibration)]
        self.config = replace(each[0], links=config.links)
        self.ladder = Ladder([Rung(Step.CHOSEN, NoSamples())], clock)
        silent_s = [max(SCAN_AGE_S, SILENT_PERIODS * one.source.period_ms / 1e3) for one in each]
        self.freshness = Freshness(max(silent_s), reach_m=math.inf, links=len(each))
        self.stages = [
            LinkStage(
                one,
                layouts[k],
                silent_s[k],
                self.freshness.links[k],
                [on_pose, *on_poses][k] if k <= len(on_poses) else None,
                calibration[k],
                extrapolate_s,
            )
            for k, one in enumerate(each)
        ]
        self.thinks_at_once = True
        self._advising = Advising(None)
        self.estimate = self.freshness.judged(NOTHING)
        self._stepped_s = 0.0

    @property
    def has_object(self) -> bool:
        return False

    @property
    def has_thought(self) -> bool:
        return False

    @property
    def doubt(self) -> CalibrationDoubt:
        """None: touches of an unknown object cannot judge a calibration."""
        return CalibrationDoubt()

    def think(self) -> Outcome | None:
        return None

    def tell(self, pose: ToldPose, of: Sequence[int] | None = None) -> str:
        del pose, of
        return "there is no object (scene.bundle is empty)"

    def reset(self) -> None:
        """Raises SetupError: there is nothing to forget."""
        raise SetupError(
            "there is no object (scene.bundle is empty), so there is nothing to forget"
        )

    @property
    def counted(self) -> EstimatorCounters:
        return EstimatorCounters()

    def _believe(self, activation: Activation, sensor: Poses, link: int) -> tuple[int, int]:
        """Nothing is believed of an activation; it is dated."""
        del sensor, link
        t = activation.t + self._stepped_s
        now = replace(NOTHING, t=t, contact=any(s.skin.touched for s in self.stages))
        self.estimate = self.freshness.judged(now)
        return 0, 0
