"""Replay of a session: the daemon's pipeline on recorded input, with no clock."""

import heapq
import json
import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from operator import itemgetter
from pathlib import Path

from taxeld import bundle, dialects, layout, messages, session
from taxeld.clock import STEP_S
from taxeld.config import Config, SensorPoseConfig
from taxeld.pipeline import Outcome, Pipeline, is_valid
from taxeld.poses import PoseTrack
from taxeld.session import Chunk, PoseRow
from taxeld.wire import Wire
from taxeld_protocol.frames import Frame

Arrival = Frame | Chunk | PoseRow


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
    poses = session.read_poses(directory / session.POSES) if track else []
    decoder = dialects.listener(pipeline.config.source, pipeline.skin.layout)
    wire = Wire(pipeline.config.source, decoder)
    before = 0, items[0].t
    # as in the daemon, a scan is taken when its last frame is there, and so are the poses
    for now, came in heapq.merge(_ordered(poses), _ordered(items), key=itemgetter(0)):
        if now[0] > before[0]:
            pipeline.clock_stepped(now[1] - before[1])
        before = now
        if isinstance(came, Frame | Chunk):
            scans = [scan for heard in wire.take(came, now[1]) for scan in heard.scans]
            yield from pipeline.advance(scans, now[1])
        elif track:
            yield from pipeline.advance((), now[1])
            track.add(*came)
    yield from pipeline.flush()


def _ordered(arrivals: Iterable[Arrival]) -> Iterator[tuple[tuple[int, float], Arrival]]:
    """Each with how often its clock was set back before, and its time: the order of arrival."""
    steps, before = 0, -math.inf
    for came in arrivals:
        t = came.t if isinstance(came, Frame | Chunk) else came[0]
        steps += t < before - STEP_S
        before = t
        yield (steps, t), came
