"""What does not change while one looks: the skin's taxels, the link, the object's shape."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.config.tables import Config
from taxeld.errors import SetupError
from taxeld.estimator.estimate import ProposalKind, Status
from taxeld.layout import read as layouts
from taxeld.model.scene import Scene
from taxeld.model.symmetry import add_m
from taxeld.proposals import bundle
from taxeld.stream import messages

Message = tuple[bytes, dict[str, Any]]  # a topic, and its map as docs/stream.md has it

UNKNOWN = "unknown"  # the name of a number that a newer daemon sends


@dataclass(frozen=True)
class Stage:
    """Of one daemon or session. Lengths in metres."""

    object: str
    layout: str
    position_m: Floats  # (M, 3) taxels in the sensor frame
    radius_m: float  # of the link
    slices: tuple[tuple[float, Floats], ...]  # height in the sensor frame, closed line (P, 2)
    scene: Scene | None = None  # None: only the streams are known
    truth: Poses | None = None  # (3,) where the object truly stands
    names: dict[str, dict[str, str]] = field(default_factory=dict)  # as in /taxeld/info

    def error_mm(self, estimate: dict[str, Any]) -> float | None:
        """Symmetry-aware ADD of the heaviest mode; None where it cannot be told."""
        if self.scene is None or self.truth is None or not estimate["valid"]:
            return None
        return 1e3 * add_m(self.scene, pose_of(estimate["map"]), self.truth)[1]

    def name(self, kind: str, number: int) -> str:
        """Of a `status` or `proposal`."""
        return self.names.get(kind, {}).get(str(number), UNKNOWN)


def pose_of(map_: dict[str, float]) -> Poses:
    return np.array([map_["x"], map_["y"], map_["theta"]])


def from_info(info: dict[str, Any]) -> Stage:
    """Of `/taxeld/info`, which has the object's outline and no slices: it stands for all heights.

    Raises:
        SetupError: the message is of another version of the stream, or lacks what it must have.
    """
    try:
        check_version(info)
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
            names={kind: dict(info[kind]) for kind in ("status", "proposal", "degraded")},
        )
    except (KeyError, TypeError, ValueError) as error:
        raise SetupError(
            f"{messages.INFO.decode()}: is not what a taxeld daemon sends ({error}); is the "
            "endpoint another program's?"
        ) from None


def from_config(config: Config, truth: Poses | None = None) -> Stage:
    """Of a configuration, with the object as its bundle has it.

    Raises:
        SetupError: what the configuration names cannot be used.
    """
    skin = layouts.load(config.skin.layout)
    loaded = bundle.load(config.scene.bundle, skin, config.skin.full_scale_depth_m)
    return of_scene(skin.name, skin.position_m, skin.radius_m, loaded.model.scene,
                    Path(str(loaded.info["object"])).name, truth)  # fmt: skip


def of_scene(
    layout: str, position_m: Floats, radius_m: float, scene: Scene, name: str, truth: Poses | None
) -> Stage:
    return Stage(
        object=name,
        layout=layout,
        position_m=position_m,
        radius_m=radius_m,
        slices=_slices(scene),
        scene=scene,
        truth=truth,
        names={
            "status": {str(int(s)): s.name.lower() for s in Status},
            "proposal": {str(int(p)): p.name.lower() for p in ProposalKind},
        },
    )


def check_version(message: dict[str, Any]) -> None:
    """Raises SetupError where a message is of another version of the stream, or of none."""
    found = message.get("v")
    if type(found) is not int:
        raise SetupError(
            "what comes is no stream of a taxeld daemon; is the endpoint another program's?"
        )
    if found != messages.VERSION:
        raise SetupError(
            f"the stream is of version {found}, where this taxeld reads {messages.VERSION}; "
            "use the taxeld of the daemon"
        )


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
