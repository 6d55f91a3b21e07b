"""Replay of a session: the daemon's pipeline on recorded input, with no clock."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from taxeld_protocol.decoder import Decoder
from taxeld_protocol.modules import wired

from taxeld import bundle, layout, messages, session
from taxeld.config import Config, SensorPoseConfig
from taxeld.pipeline import Pipeline, is_valid
from taxeld.poses import PoseTrack


def replay(directory: Path, config: Config, seed: int | None = None) -> Iterator[str]:
    """One JSON line a scan: the map of `/taxeld/estimate`. Same input and seed, same bytes.

    Raises:
        SetupError: the session or what the configuration names cannot be used.
    """
    if seed is not None:
        config = replace(config, filter=replace(config.filter, seed=seed))
    moves = (directory / session.POSES).exists()
    if not moves:  # recorded without a robot
        config = replace(config, sensor_pose=SensorPoseConfig())
    skin_layout = layout.load(config.skin.layout)
    frames = session.read_frames(directory / session.FRAMES)
    poses = iter(session.read_poses(directory / session.POSES) if moves else [])
    scene = bundle.load(config.scene.bundle, skin_layout, config.skin.full_scale_depth_m)
    pipeline = Pipeline(config, skin_layout, scene)
    modules = wired(skin_layout.uid.tolist())
    decoder = Decoder(lambda _: modules)
    coming = next(poses, None)
    seq = 0
    for frame in frames:
        # as in the daemon, a scan is taken when its last frame is there, and so are the poses
        while coming is not None and isinstance(pipeline.poses, PoseTrack) and coming[0] <= frame.t:
            pipeline.poses.add(*coming)
            coming = next(poses, None)
        for scan in decoder.feed(frame)[1]:
            outcome = pipeline.on_scan(scan)
            message = messages.estimate(outcome.estimate, seq=seq, valid=is_valid(outcome.estimate))
            seq += 1
            yield json.dumps(message, separators=(",", ":"))
