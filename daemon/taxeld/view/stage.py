"""The still part of a picture: the skin's taxels, the link and the object's shape."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.config.tables import Config
from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld.model.scene import Scene
from taxeld.model.symmetry import add_m
from taxeld.proposals import bundle
from taxeld.stream import messages

Message = tuple[bytes, dict[str, Any]]  # a topic, and its map as docs/stream.md has it


@dataclass(frozen=True)
class Stage:
    """Skin and object of one daemon or session. Lengths in metres."""

    object: str
    layout: str
    position_m: Floats  # (M, 3) taxels in the sensor frame
    radius_m: float  # of the link
    slices: tuple[tuple[float, Floats], ...]  # height in the sensor frame, closed line (P, 2)
    scene: Scene | None = None  # None where only the streams are known
    truth: Poses | None = None  # (3,) where the object truly stands

    def error_mm(self, estimate: dict[str, Any]) -> float | None:
        """Symmetry-aware ADD of the heaviest mode; None without scene, truth or valid estimate."""
        if self.scene is None or self.truth is None or not estimate["valid"]:
            return None
        return 1e3 * add_m(self.scene, pose_of(estimate["map"]), self.truth)[1]


def pose_of(planar: dict[str, float]) -> Poses:
    """(3,) of `x`, `y`, `theta`."""
    return np.array([planar["x"], planar["y"], planar["theta"]])


def name_of(kind: type[IntEnum], number: int) -> str:
    """The name of a status or proposal; a newer daemon may send one that is not known here."""
    names = {int(one): one.name.lower() for one in kind}
    return names.get(number, f"unknown ({number})")


def from_info(info: dict[str, Any]) -> Stage:
    """Stage of `/taxeld/info`, whose outline stands for the object at all heights.

    Raises:
        SetupError: the message lacks what it must have.
    """
    try:
        layout = info["layout"]
        position = np.array(layout["position_m"], dtype=float).reshape(-1, 3)
        line = _closed(np.array(info["outline"], dtype=float).reshape(-1, 2))
        heights = np.unique([position[:, 2].min(), position[:, 2].max()])
        return Stage(
            object=Path(str(info["object"])).name,
            layout=str(layout["name"]),
            position_m=position,
            radius_m=float(layout["radius_m"]),
            slices=tuple((float(height), line) for height in heights),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise SetupError(
            f"{messages.INFO.decode()}: is not what a taxeld daemon sends ({error}); is the "
            "endpoint another program's?"
        ) from None


def from_config(config: Config, truth: Sequence[float] | None = None) -> Stage:
    """Stage of a configuration, with the object's slices from its bundle. `truth`: x, y, yaw.

    Raises:
        SetupError: what the configuration names cannot be used.
    """
    skin = layouts.load(config.skin.layout)
    loaded = bundle.load(config.scene.bundle, skin, config.skin.full_scale_depth_m)
    name = Path(str(loaded.info["object"])).name
    return of_scene(skin, loaded.model.scene, name, None if truth is None else np.array(truth))


def of_scene(skin: Layout, scene: Scene, name: str, truth: Poses | None) -> Stage:
    slices = _slices(scene)
    return Stage(name, skin.name, skin.position_m, skin.radius_m, slices, scene, truth)


def _slices(scene: Scene) -> tuple[tuple[float, Floats], ...]:
    """The zero lines of the scene's grids; the outline at each height where nothing cuts them."""
    try:
        from contourpy import contour_generator  # noqa: PLC0415  (comes with the extra `view`)
    except ModuleNotFoundError:
        line = _closed(scene.outline)
        return tuple((float(height), line) for height in scene.heights)
    found: list[tuple[float, Floats]] = []
    for height, grid in zip(scene.heights, scene.slices, strict=True):
        lines = contour_generator(z=grid).lines(0.0)
        found += [(float(height), scene.origin + scene.cell * np.asarray(line)) for line in lines]
    return tuple(found)


def _closed(line: Floats) -> Floats:
    return np.vstack([line, line[:1]])
