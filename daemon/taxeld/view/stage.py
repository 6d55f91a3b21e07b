"""The skin and the object of a picture, and a session as the messages that a daemon would send."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.commands.replay import Replay
from taxeld.config.tables import Config
from taxeld.layout import read as layouts
from taxeld.model.scene import Scene
from taxeld.model.symmetry import add_m
from taxeld.proposals import several
from taxeld.source import session
from taxeld.stream import messages
from taxeld.view.streams import Message

PARTICLES_S = 0.05  # between two clouds of particles, as the daemon sends them


@dataclass(frozen=True)
class Thing:
    """An object that may be felt."""

    name: str
    outline: Floats  # (P, 2) in its own frame
    scene: Scene | None = None  # None where only the streams are known


@dataclass(frozen=True)
class Stage:
    """Skin and objects of one daemon or session. Lengths in metres."""

    things: list[Thing]  # by the numbers in estimates
    layout: str  # its name
    position_m: Floats  # (M, 3) taxels in the sensor frame
    radius_m: float  # of the link
    truth: Poses | None = None  # (3,) true pose of the object, where it is known which it is
    is_live: bool = False  # scans of a daemon have latencies, those of a session have none

    def error_mm(self, estimate: dict[str, Any]) -> float | None:
        """Symmetry-aware ADD of the heaviest mode; None without scene, truth or valid estimate."""
        scene = self.things[0].scene if self.things else None
        if scene is None or self.truth is None or not estimate["valid"]:
            return None
        return 1e3 * add_m(scene, pose_of(estimate["map"]), self.truth)[1]


def pose_of(planar: dict[str, float]) -> Poses:
    """(3,) of `x`, `y`, `theta`."""
    return np.array([planar["x"], planar["y"], planar["theta"]])


def from_info(info: dict[str, Any], scenes: Sequence[Scene] = ()) -> Stage:
    """Stage of `/taxeld/info`, with the objects' scenes where they are known."""
    layout, objects = info["layout"], info["objects"]
    known = scenes if len(scenes) == len(objects) else [None] * len(objects)
    return Stage(
        things=[
            Thing(Path(each["name"]).name, np.array(each["outline"]), scene)
            for each, scene in zip(objects, known, strict=True)
        ],
        layout=layout["name"],
        position_m=np.array(layout["position_m"]),
        radius_m=layout["radius_m"],
        is_live=True,
    )


def scenes_of(config: Config) -> list[Scene]:
    """The scenes of a configuration's bundles.

    Raises:
        SetupError: what the configuration names cannot be used.
    """
    skins = [layouts.load(config.skin.layout)]
    bundles = several.load(config.scene, skins, config.skin.full_scale_depth_m)
    return [one.model.scene for one in bundles]


def recorded(directory: Path, config: Path | None = None) -> tuple[Stage, Iterator[Message]]:
    """Stage and messages of a session; `config` replaces the session's own. Each scan gives taxels,
    an estimate and particles, as far as it has them.

    Raises:
        SetupError: there is no session, or what its configuration names cannot be used; while the
            messages are read, also: the session is damaged.
    """
    replay = Replay(directory, session.config_of(directory, config))
    skin = replay.layout
    pipeline = replay.pipeline
    scenes = [known.model.scene for known in pipeline.estimator.known] if replay.names else []
    pairs = zip(replay.names, scenes, strict=True)
    truth = truth_of(directory / session.TRUTH)
    stage = Stage(
        things=[Thing(Path(name).name, scene.outline, scene) for name, scene in pairs],
        layout=skin.name,
        position_m=skin.position_m,
        radius_m=skin.radius_m,
        truth=truth if len(scenes) == 1 else None,  # a session does not say which one stood there
    )
    return stage, _messages(replay)


def truth_of(path: Path) -> Poses | None:
    """(3,) the object's last true pose of a session's table; None where there is no table.

    Raises:
        SetupError: the table is damaged.
    """
    rows = session.read_poses(path) if path.exists() else None
    return np.array(rows[-1][1:]) if rows else None


def _messages(replay: Replay) -> Iterator[Message]:
    next_s = -np.inf  # the next cloud of particles is due at this time
    for seq, outcome in enumerate(replay):
        estimate, activation = outcome.estimate, outcome.activation
        if activation is not None and not outcome.link:  # the first link alone is drawn
            yield messages.TAXELS, messages.taxels(activation, outcome.sensor, seq)
            if replay.patches[outcome.link].now or activation.z.any():
                yield messages.CONTACTS, replay.contacts(outcome, seq)
        if not (estimate.t and replay.names):  # nothing was measured yet
            continue
        message = messages.estimate(estimate, names=replay.names, seq=seq, why=replay.why(estimate))
        yield messages.ESTIMATE, message
        if estimate.contact and not estimate.t < next_s < estimate.t + 1.0:
            next_s = estimate.t + PARTICLES_S
            yield messages.PARTICLES, messages.particles(estimate.t, seq, *replay.belief)
