"""The lines that a daemon at work logs: that it is ready, and each change once.

A change of status is logged when it comes; poses and modules are looked at once a second. The
service manager bounds how many lines there are (LogRateLimitBurst=).
"""

import logging
import math
from collections.abc import Sequence

from taxeld.estimator.estimate import Estimate, Status
from taxeld.pipeline.freshness import CURES, Why
from taxeld.pipeline.stage import LinkStage
from taxeld.service.prepare import Prepared
from taxeld.skin.channels import mismatch

SURE = 0.99  # least probability of an object that is named
GRAVE = (Status.STALE, Status.BLIND, Status.INCONSISTENT)
STATUS_S, STATUS_MOST_S = 0.5, 10.0  # pause after a line on the status; it doubles while that flaps
MODULES_LOOKS = 3  # seconds without another module, after which some are said to be missing

log = logging.getLogger(__name__)


class Notices:
    def __init__(self, made: Prepared, names: Sequence[str]) -> None:
        """`names`: of the objects that it may be."""
        self._made, self._names = made, names
        self._object = 0 if len(names) == 1 else -1  # number of the last one that was logged
        self._status: tuple[Status, Why] | None = None  # the last, and why it was not valid
        self._logged_s, self._pause_s = -math.inf, STATUS_S  # of that line
        self._said: dict[str, str] = {}  # the last line on each subject
        self._looks = 0  # since the modules of a hub have changed

    def ready(self, waits_for: str) -> None:
        """All is open and warm; the first link's source `waits_for` something."""
        config, layout, bundles = self._made.config, self._made.layouts[0], self._made.bundles
        source, poses = config.source, config.sensor_pose.endpoint
        parts = [f"skin {layout.name}, {len(layout)} taxels", "no object: the skin alone"]
        if bundles:
            paths = ", ".join(str(one.path) for one in bundles)
            proposal = self._made.pipeline.samples.name
            parts[1:] = [f"object {' or '.join(self._names)}", f"samples by {proposal} of {paths}"]
        parts += [
            f"source {source.kind} {source.where}, {'not there yet' if waits_for else 'open'}",
            f"sensor poses {f'from {poses}' if poses else 'none: it stands still'}",
            f"streams at {', '.join(config.publish.endpoints) or 'nowhere'}",
            f"control at {config.control.endpoint or 'nowhere'}",
        ]
        log.info("ready: %s", "; ".join(parts))

    def estimate(self, estimate: Estimate, why: Why, reason: str, now_s: float) -> None:
        """Log a published estimate if its status, or why it is not valid, has changed; `reason`:
        the same in words. So is the object, once it is known. `now_s` is monotonic."""
        number, status = estimate.object, estimate.status
        if estimate.objects and number != self._object and estimate.objects[number] >= SURE:
            self._object = number
            name, p = self._names[number], estimate.objects[number]
            log.info("object: %s, p %.1f %%", name, 100.0 * p)
        passed_s = now_s - self._logged_s
        if (status, why) == self._status or passed_s < self._pause_s:
            return
        flaps = passed_s < 2.0 * self._pause_s
        self._pause_s = min(2.0 * self._pause_s, STATUS_MOST_S) if flaps else STATUS_S
        self._status, self._logged_s = (status, why), now_s
        x, y, yaw = estimate.map
        line = f"{status.name.lower()}, {'not ' if reason else ''}valid"
        line += f", {estimate.contacts} contacts"
        where = f", x {x:.4f} m, y {y:.4f} m, yaw {yaw:.3f} rad, p {estimate.p:.1%}"
        line += f": {reason}" if reason else f"{where}, radius {1e3 * estimate.radius_m:.1f} mm"
        log.log(logging.WARNING if status in GRAVE else logging.INFO, "status: %s", line)

    def inputs(self, poses_fault: str, now_s: float) -> None:
        """Once a second: log what has changed of the robot's poses, of the modules that the hubs
        have, and which of several links has ceased to work. `now_s` is monotonic."""
        self._say("sensor_pose", poses_fault, "poses come as they should")
        pipeline = self._made.pipeline
        names, whys = pipeline.config.names, pipeline.freshness.of_links(now_s)
        self._looks += 1
        for name, stage, why in zip(names, pipeline.stages, whys, strict=True):
            of = ""
            if len(names) > 1:
                of = f"{name}: "
                works = why in (Why.VALID, Why.STARTING)
                fault = "" if works else f"is left out, {CURES[why]}"
                self._say(f"link {name}", fault, "works")
            self._modules(of, stage)

    def _modules(self, of: str, stage: LinkStage) -> None:
        wiring = stage.skin.wiring
        for hub, suis in wiring.hubs.items():
            known = len(set(suis) & set(wiring.suis))
            self._said.setdefault(f"{of}hub {hub} sends", "nothing yet")
            line = f"{len(suis)} modules, {known} of them in the layout"
            if self._say(f"{of}hub {hub} sends", "", line):
                self._looks = 0
        if wiring.hubs and self._looks > MODULES_LOOKS:
            lacking, foreign = wiring.lacking, len(wiring.foreign)
            line = mismatch(lacking, len(wiring.suis), foreign, stage.fresh.is_whole)
            self._say(f"{of}skin.layout", line, "all its modules are there")

    def _say(self, subject: str, fault: str, fine: str) -> bool:
        """Warn of a fault, or log `fine` where there is none; → whether that has changed."""
        line = fault or fine
        if line == self._said.get(subject, fine):
            return False
        self._said[subject] = line
        log.log(logging.WARNING if fault else logging.INFO, "%s: %s", subject, line)
        return True
