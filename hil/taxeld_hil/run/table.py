"""What a run prints while it goes on: a line for each contact that has ended."""

from typing import Any

import numpy as np

from taxeld.arrays import Poses
from taxeld.model.scene import Scene
from taxeld.model.symmetry import add_m
from taxeld.stream import messages

HEADER = (
    "contact  taxels  modes       p  radius [mm]  likeliest x, y, yaw [mm, mm, deg]  error [mm]"
)
OBJECT = "  object"  # ends the header where the daemon knows several


class ContactTable:
    """Follows a daemon's streams. Where it knows several objects, each line ends with the
    likeliest."""

    def __init__(self, scene: Scene, truth: Poses | None) -> None:
        """`truth` (3,): the object's pose, None where it is not known."""
        self._scene, self._truth = scene, truth
        self._most_taxels = 0
        self._in_contact = False

    def on_taxels(self, message: dict[str, Any]) -> None:
        self._most_taxels = max(self._most_taxels, sum(z > 0 for z in message["z"]))

    def on_estimate(self, message: dict[str, Any]) -> str | None:
        """The line of a contact that has just ended."""
        ended = self._in_contact and not message["contact"]
        self._in_contact = message["contact"]
        if not ended:
            return None
        pose = np.array([message["map"][key] for key in ("x", "y", "theta")])
        (x, y), yaw = 1e3 * pose[:2], np.degrees(pose[2])
        line = (
            f"{message['contacts']:7d} {self._most_taxels:7d} {len(message['modes']):6d} "
            f"{message['p']:7.1%} {1e3 * message['radius_m']:12.1f}    "
            f"({x:7.1f}, {y:7.1f}, {yaw:6.1f})"
        )
        self._most_taxels = 0
        if self._truth is not None:
            is_valid = message["valid"]
            error_m = add_m(self._scene, pose, self._truth)[1] if is_valid else np.nan
            line += f" {1e3 * error_m:16.1f}"
        several = len(message["objects"]) > 2  # beside `other`
        return f"{line}  {messages.object_of(message)}" if several else line
