"""One link's way to the estimator: its skin, its sensor's poses, and the scans that wait for
them."""

import math
from collections import deque
from dataclasses import asdict
from typing import Any

import numpy as np

from taxeld.config.tables import Config
from taxeld.estimator.rule import noise_of
from taxeld.layout.layout import Layout
from taxeld.pipeline.freshness import LinkInputs, Why
from taxeld.pipeline.outcome import InputCounters, later
from taxeld.pipeline.poses import OnPose, Pace, PoseTrack, StandingStill
from taxeld.skin.calibration import Calibration
from taxeld.skin.skin import Skin
from taxeld.skin.state import SkinState
from taxeld_protocol.decoder import Scan

FUTURE_S = 0.1  # a scan stamped farther in the future was stamped wrongly
SCAN_AGE_S = 0.5  # a scan that is older when it arrives is not used
WAITING_MAX = 64  # scans that may wait; beyond, the oldest wait no longer


class LinkStage:
    """Holds what belongs to one link alone. Times within are without the steps of the Unix clock,
    as in `Pipeline`."""

    def __init__(
        self,
        config: Config,
        layout: Layout,
        silent_s: float,
        fresh: LinkInputs,
        on_pose: OnPose | None,
        calibration: Calibration | None,
        extrapolate_s: float,
    ) -> None:
        """`config`: of this link, with the values of its calibration. `silent_s`: time [s] after
        which a hub without a scan is silent. `fresh`: what became of the link's last scan."""
        self.config, self.calibration, self.fresh = config, calibration, fresh
        self.skin = Skin(layout, config.skin, silent_s, calibration, noise=noise_of(config.filter))
        self.poses: PoseTrack | StandingStill = StandingStill()
        if config.sensor_pose.endpoint:
            mount = None if calibration is None else calibration.mount
            reach_m = float(np.hypot(*layout.position_m[:, :2].T).max())
            self.poses = PoseTrack(on_pose, mount, extrapolate_s, reach_m)
        self.pace = Pace(config.source.period_ms / 1e3 if config.source.is_unstamped else math.inf)
        self.inputs = InputCounters()
        self.waiting: deque[tuple[float, Scan]] = deque()  # scans with their times of arrival

    def arrive(self, scan: Scan, now: float, stepped_s: float) -> float | None:
        """Take a scan that has arrived at the Unix time `now`; → its age [s] where it is refused,
        as too old or from the future."""
        age = now - scan.t
        if -FUTURE_S <= age <= SCAN_AGE_S:
            self.waiting.append((now - stepped_s, later(scan, -stepped_s)))
            self.inputs.scans_waited += not self.poses.reaches(scan.t)
            return None
        if age > 0.0:
            self.inputs.scans_old += 1
        else:
            self.inputs.scans_from_the_future += 1
        self.fresh.last = Why.SCANS_MISTIMED
        return age

    def is_due(self, now: float, stepped_s: float) -> bool:
        """Whether the first waiting scan need not wait any longer."""
        arrived, scan = self.waiting[0]
        waited = now - arrived >= self.config.sensor_pose.wait_s
        has_pose = self.poses.reaches(scan.t + stepped_s)
        return waited or has_pose or len(self.waiting) > WAITING_MAX

    def state(self, stepped_s: float) -> SkinState | None:
        """The skin's learned state in Unix time; None before there is any."""
        state = self.skin.state()
        return None if state is None else later(state, stepped_s)

    def tare(self) -> None:
        """Learn the idle baseline anew; the skin must not be touched."""
        self.skin.tare()
        self.fresh.last = Why.STARTING

    def counts(self) -> dict[str, int]:
        """Counts of poses, and of scans before their use; waiting ones are not counted yet."""
        return {
            **asdict(self.inputs),
            "scans_waiting": len(self.waiting),
            "poses": self.poses.taken,
            "poses_rejected": self.poses.rejected,
        }

    def health(self) -> dict[str, Any]:
        """Counters of the skin since start, and the taxels that cannot be believed."""
        return {
            "skin": {
                **asdict(self.skin.counters),
                "lowered": self.skin.lowered,
                "gain": self.skin.fit.gain,
            },
            "modules": {"layout": self.skin.modules, "foreign": len(self.skin.wiring.foreign)},
            **self.skin.faults(),
        }
