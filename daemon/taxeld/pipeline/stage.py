"""One link's way to the estimator: its skin, its sensor's poses, and the scans that wait for
them."""

import math
from collections import deque
from dataclasses import asdict, dataclass, replace
from typing import Any, TypeVar

import numpy as np

from taxeld.arrays import Poses
from taxeld.config.tables import Config
from taxeld.estimator.scans import noise_of
from taxeld.layout.layout import Layout
from taxeld.model.observation import Activation
from taxeld.pipeline.freshness import LinkInputs, Why
from taxeld.pipeline.poses import Pace, PoseTrack, StandingStill
from taxeld.skin.calibration import Calibration, SkinState
from taxeld.skin.skin import Skin
from taxeld_protocol.decoder import Scan

FUTURE_S = 0.1  # a scan stamped farther in the future was stamped wrongly
SCAN_AGE_S = 0.5  # a scan that is older when it arrives is not used
SILENT_PERIODS = 3.0  # scan periods without a scan: a hub is silent, all is stale
WAITING_MAX = 64  # scans that may wait; beyond, the oldest wait no longer

Dated = TypeVar("Dated", Scan, Activation, SkinState)


@dataclass(slots=True)
class InputCounters:
    """Counters of the inputs, since start."""

    scans_old: int = 0  # scans older than their limit when they arrived, not used
    scans_from_the_future: int = 0  # scans later than now, or without a time, not used
    scans_without_pose: int = 0  # scans without a sensor pose near in time, not used
    scans_waited: int = 0  # scans that waited for a pose at or after their time
    clock_steps: int = 0  # steps of the Unix clock


class LinkStage:
    """Holds what belongs to one link alone. The skin and waiting scans use a time without the steps
    of the Unix clock: Unix time less `stepped_s`."""

    def __init__(
        self,
        config: Config,
        layout: Layout,
        calibration: Calibration | None,
        extrapolate_s: float,
    ) -> None:
        """`config`: of this link."""
        self.config, self.calibration = calibrated(config, calibration), calibration
        period_s = config.source.period_ms / 1e3
        self.silent_s = max(SCAN_AGE_S, SILENT_PERIODS * period_s)  # without a scan of a hub
        noise = noise_of(self.config.filter)
        self.skin = Skin(layout, self.config.skin, self.silent_s, calibration, noise=noise)
        self.poses: PoseTrack = StandingStill()
        if config.sensor_pose.endpoint:
            mount = None if calibration is None else calibration.mount
            reach_m = float(np.hypot(*layout.position_m[:, :2].T).max())
            self.poses = PoseTrack(mount, extrapolate_s, reach_m)
        self._pace = Pace(period_s if config.source.is_unstamped else math.inf)
        self.fresh = LinkInputs()
        self.inputs = InputCounters()
        self.waiting: deque[tuple[float, Scan]] = deque()  # scans with their times of arrival

    def arrive(self, scan: Scan, now: float, stepped_s: float) -> bool:
        """Take a scan that has arrived at the Unix time `now`, unless it is too old or from the
        future; → whether it was taken."""
        age_s = now - scan.t
        if -FUTURE_S <= age_s <= SCAN_AGE_S:
            self.waiting.append((now - stepped_s, later(scan, -stepped_s)))
            self.inputs.scans_waited += not self.poses.reaches(scan.t)
            return True
        self.inputs.scans_old += age_s > 0.0
        self.inputs.scans_from_the_future += not age_s > 0.0
        self.fresh.last = Why.SCANS_MISTIMED
        return False

    def is_due(self, now: float, stepped_s: float) -> bool:
        """Whether the first waiting scan need not wait any longer, at the Unix time `now`."""
        arrived, scan = self.waiting[0]
        waited = now - stepped_s - arrived >= self.config.sensor_pose.wait_s
        has_pose = self.poses.reaches(scan.t + stepped_s)
        return waited or has_pose or len(self.waiting) > WAITING_MAX

    def take(self, stepped_s: float) -> tuple[float, Activation | None, Poses | None]:
        """The first waiting scan: its time, its activation, None before there is a baseline, and
        its sensor's pose (3,), None where it is not known well enough."""
        scan = self.waiting.popleft()[1]
        late_s = self._pace.late_s(scan.ihb, scan.t)
        activation = self.skin.on_scan(scan)
        self.fresh.is_whole = len(self.skin.wiring.lacking) <= self.config.skin.missing_modules
        if activation is None:
            self.fresh.last = Why.STARTING
            return scan.t, None, None
        t = scan.t + stepped_s
        sensor, sd_m = self.poses.at(t), self.poses.sd_m(t, late_s)
        if sensor is None or sd_m > self.config.filter.within_m:
            self.inputs.scans_without_pose += 1
            self.fresh.last = Why.NO_POSE
            return scan.t, activation, None
        self.fresh.last = Why.VALID
        return scan.t, replace(activation, place_sd_m=sd_m), sensor

    def tare(self) -> None:
        """Learn the idle baseline anew; the skin must not be touched."""
        self.skin.tare()
        self.fresh.last = Why.STARTING

    def health(self) -> dict[str, Any]:
        """Counts since start of poses, of scans before their use (those that wait are not counted
        yet), and of the skin; and the taxels that cannot be believed."""
        skin = self.skin
        return {
            "inputs": {
                **asdict(self.inputs),
                "scans_waiting": len(self.waiting),
                "poses": self.poses.taken,
                "poses_rejected": self.poses.rejected,
            },
            "skin": {
                **asdict(skin.counters),
                "gain": skin.fit.gain,
                "answers": float(skin.fit.fit.answers.mean()),
            },
            "modules": {"layout": len(skin.wiring.suis), "foreign": len(skin.wiring.foreign)},
            **skin.faults(),
        }


def calibrated(config: Config, calibration: Calibration | None) -> Config:
    """The configuration with measured values: full scale, and the filter's noise and gain
    spread."""
    if calibration is None:
        return config
    c = calibration
    return replace(
        config,
        skin=replace(config.skin, full_scale_counts=c.full_scale_counts),
        filter=replace(config.filter, noise_sigma=c.noise_sigma, gain_cv=c.gain_cv),
    )


def later(dated: Dated, by: float) -> Dated:
    """The same at a time that is later by `by` seconds."""
    return replace(dated, t=dated.t + by) if by else dated
