"""Replay of a session: the daemon's pipeline on recorded input, without a clock."""

import heapq
import json
import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from operator import itemgetter
from pathlib import Path

from taxeld.config.tables import Config
from taxeld.layout import read as layouts
from taxeld.pipeline.outcome import Outcome
from taxeld.pipeline.pipeline import Pipeline
from taxeld.proposals import bundle
from taxeld.service import calibration_file
from taxeld.service.clock import is_step
from taxeld.source import dialects, session
from taxeld.source.session import Chunk, PoseRow
from taxeld.source.wire import Wire
from taxeld.stream import messages
from taxeld_protocol.frames import Frame

Arrival = Frame | Chunk | PoseRow


def replay(directory: Path, config: Config, seed: int | None = None) -> Iterator[str]:
    """One JSON line a scan: the map of `/taxeld/estimate`. Same input and seed, same bytes.

    Raises:
        SetupError: the session or what the configuration names cannot be used.
    """
    if seed is not None:
        config = replace(config, filter=replace(config.filter, seed=seed))
    pipeline = open_pipeline(directory, config)
    for seq, outcome in enumerate(outcomes(directory, pipeline)):
        valid = pipeline.freshness.is_valid(outcome.estimate)
        message = messages.estimate(outcome.estimate, seq=seq, valid=valid)
        yield json.dumps(message, separators=(",", ":"))


def open_pipeline(directory: Path, config: Config) -> Pipeline:
    """The pipeline of a session: with a sensor pose where one was recorded, whatever the
    configuration says of an endpoint, and with the bundle's first choice for `auto`, whatever it
    costs here.

    Raises:
        SetupError: what the configuration names cannot be used.
    """
    where = str(directory) if session.has_poses(directory) else ""
    # all poses are there: each scan is placed between two, and none by those before it alone
    moves = replace(config.sensor_pose, endpoint=where, extrapolate_s=0.0)
    config = replace(config, sensor_pose=moves)
    skin = layouts.load(config.skin.layout)
    loaded = bundle.load(config.scene.bundle, skin, config.skin.full_scale_depth_m)
    begun = session.begun(directory) if config.skin.calibration else 0.0
    calibration = calibration_file.load(config.skin, skin, begun, recorded=True)
    return Pipeline(config, loaded.model, loaded.untimed(config.filter), calibration=calibration)


def outcomes(directory: Path, pipeline: Pipeline) -> Iterator[Outcome]:
    """What each scan of a session led to.

    Raises:
        SetupError: the session cannot be read, or nothing tells the order of its modules, or which
            boards it is of.
    """
    recorded = session.read(directory)
    if not recorded.items:  # cut before the first
        return
    config, layout = pipeline.config.source, pipeline.skin.layout
    wire = Wire(config, dialects.replayed(config, layout, recorded.items, str(directory)))
    before = 0, recorded.items[0].t
    # as in the daemon, a scan is taken when its last frame is there, and so are the poses
    arrivals = heapq.merge(_ordered(recorded.poses), _ordered(recorded.items), key=itemgetter(0))
    for now, came in arrivals:
        if now[0] > before[0]:
            pipeline.clock_stepped(now[1] - before[1])
        before = now
        if isinstance(came, Frame | Chunk):
            scans = [scan for heard in wire.take(came, now[1]) for scan in heard.scans]
            yield from pipeline.advance(scans, now[1])
        else:
            yield from pipeline.advance((), now[1])
            pipeline.poses.add(*came)
    yield from pipeline.flush()


def _ordered(arrivals: Iterable[Arrival]) -> Iterator[tuple[tuple[int, float], Arrival]]:
    """Each with how often the clock was set back before, and its time: the order of arrival.

    Only a step back shows in a recording: one forward looks like a pause.
    """
    steps, before = 0, -math.inf
    for came in arrivals:
        t = came.t if isinstance(came, Frame | Chunk) else came[0]
        steps += is_step(min(t - before, 0.0))
        before = t
        yield (steps, t), came
