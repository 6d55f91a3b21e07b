"""Replay of a session: the daemon's pipeline on recorded input, with no clock."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from taxeld import bundle, dialects, layout, messages, session
from taxeld.config import Config, SensorPoseConfig
from taxeld.pipeline import Outcome, Pipeline, is_valid
from taxeld.poses import PoseTrack
from taxeld.wire import Wire


def replay(directory: Path, config: Config, seed: int | None = None) -> Iterator[str]:
    """One JSON line a scan: the map of `/taxeld/estimate`. Same input and seed, same bytes.

    Raises:
        SetupError: the session or what the configuration names cannot be used.
    """
    if seed is not None:
        config = replace(config, filter=replace(config.filter, seed=seed))
    for seq, outcome in enumerate(outcomes(directory, open_pipeline(directory, config))):
        message = messages.estimate(outcome.estimate, seq=seq, valid=is_valid(outcome.estimate))
        yield json.dumps(message, separators=(",", ":"))


def open_pipeline(directory: Path, config: Config) -> Pipeline:
    """The pipeline that a session asks for: without a sensor pose where it recorded none.

    Raises:
        SetupError: what the configuration names cannot be used.
    """
    if not (directory / session.POSES).exists():
        config = replace(config, sensor_pose=SensorPoseConfig())
    skin = layout.load(config.skin.layout)
    loaded = bundle.load(config.scene.bundle, skin, config.skin.full_scale_depth_m)
    return Pipeline(config, skin, loaded)


def outcomes(directory: Path, pipeline: Pipeline) -> Iterator[Outcome]:
    """What each scan of a session led to.

    Raises:
        SetupError: the session cannot be read.
    """
    items = session.read_input(directory)
    track = pipeline.poses if isinstance(pipeline.poses, PoseTrack) else None
    poses = iter(session.read_poses(directory / session.POSES) if track else [])
    decoder = dialects.listener(pipeline.config.source, pipeline.skin.layout)
    wire = Wire(pipeline.config.source, decoder)
    coming = next(poses, None)
    for item in items:
        # as in the daemon, a scan is taken when its last frame is there, and so are the poses
        while track and coming and coming[0] <= item.t:
            track.add(*coming)
            coming = next(poses, None)
        for heard in wire.take(item, item.t):
            for scan in heard.scans:
                yield pipeline.on_scan(scan)
