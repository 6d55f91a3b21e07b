"""What a run prints: one line a contact, and at the end the error and the latencies."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from taxeld.arrays import Poses
from taxeld.estimator.estimate import Status
from taxeld.model.scene import Scene
from taxeld.model.symmetry import add_m
from taxeld.stream import messages

HEADER = (
    "contact  taxels  modes       p  radius [mm]  likeliest x, y, yaw [mm, mm, deg]  error [mm]"
)
OBJECT = "  object"  # ends the header where the daemon knows several


@dataclass(slots=True)
class ContactTable:
    """Follows the streams of a daemon; the truth, where it is known, grades the estimates. Where
    the daemon knows several objects, each line ends with the likeliest of them."""

    scene: Scene
    truth: Poses | None
    most_taxels: int = 0
    last: dict[str, Any] = field(default_factory=dict)
    lat_us: dict[str, list[float]] = field(default_factory=dict)
    sure_after: int = 0  # contacts after which it was sure and stayed so; 0: it is not
    _in_contact: bool = False

    def on_taxels(self, message: dict[str, Any]) -> None:
        self.most_taxels = max(self.most_taxels, sum(z > 0 for z in message["z"]))

    def on_estimate(self, message: dict[str, Any]) -> str | None:
        """The line of a contact that has just ended."""
        self.last = message
        is_sure = message["status"] == Status.CONVERGED
        self.sure_after = (self.sure_after or message["contacts"]) if is_sure else 0
        if message["lat_us"]["skin"] > 0:
            for stage, value in message["lat_us"].items():
                self.lat_us.setdefault(stage, []).append(value)
        ended = self._in_contact and not message["contact"]
        self._in_contact = message["contact"]
        if not ended:
            return None
        line = (
            f"{message['contacts']:7d} {self.most_taxels:7d} {len(message['modes']):6d} "
            f"{message['p']:7.1%} {1e3 * message['radius_m']:12.1f}    {_pose(message['map'])}"
        )
        self.most_taxels = 0
        line = line if self.truth is None else f"{line} {self.error_mm():16.1f}"
        several = len(message["objects"]) > 2  # beside `other`
        return f"{line}  {messages.object_of(message)}" if several else line

    def error_mm(self) -> float:
        """Symmetry-aware ADD of the last likeliest pose; not a number where there is none."""
        if self.truth is None or not self.last or not self.last["valid"]:
            return float("nan")
        pose = self.last["map"]
        estimate = np.array([pose["x"], pose["y"], pose["theta"]])
        return 1e3 * add_m(self.scene, estimate, self.truth)[1]

    def final(self) -> str:
        """A line on the last error."""
        about = "mean distance of the object's points, up to its symmetry"
        return f"final error {self.error_mm():.1f} mm ({about})"

    def sure(self) -> str:
        """After how many contacts the daemon became sure, as it still is."""
        return f"sure after {self.sure_after} contacts" if self.sure_after else "not sure"

    def latencies(self) -> list[str]:
        """A line a stage: median, 99th percentile and maximum of ticks with a scan."""
        lines = ["latency [ms]   median     p99     max"]
        for stage in messages.STAGES:
            p50, p99, top = np.percentile(self.lat_us.get(stage, [0.0]), (50, 99, 100)) / 1e3
            lines.append(f"{stage:12s} {p50:8.2f} {p99:7.2f} {top:7.2f}")
        return lines


def _pose(pose: dict[str, float]) -> str:
    degrees = np.degrees(pose["theta"])
    return f"({pose['x'] * 1e3:7.1f}, {pose['y'] * 1e3:7.1f}, {degrees:6.1f})"
