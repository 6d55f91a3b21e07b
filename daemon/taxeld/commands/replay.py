"""Replay of a session: the daemon's pipeline on recorded input, without a clock."""

import heapq
import json
import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from operator import itemgetter
from pathlib import Path
from typing import Any

from taxeld.arrays import Floats, Poses
from taxeld.config.tables import Config
from taxeld.errors import SetupError
from taxeld.estimator.estimate import Estimate
from taxeld.layout import read as layouts
from taxeld.model.observation import ObservationModel
from taxeld.pipeline.freshness import Why
from taxeld.pipeline.pipeline import Outcome, Pipeline
from taxeld.proposals import bundle
from taxeld.service.clock import is_step
from taxeld.service.prepare import prepared
from taxeld.skin.patches import Patches
from taxeld.source import module_order, session
from taxeld.source.buses import Bus, joint
from taxeld.source.session import Chunk, PoseRow
from taxeld.source.source import Source
from taxeld.source.wire import Wire
from taxeld.stream import messages
from taxeld_protocol.array import ArrayFrame
from taxeld_protocol.decoder import Scan
from taxeld_protocol.frames import Frame

Item = Frame | Chunk | ArrayFrame
Arrival = Item | PoseRow


class Replay:
    """A recorded session, estimated anew; iterating over it goes through its scans, once.

    The same session, configuration and seed give the same bytes on one machine and one build.
    """

    def __init__(
        self, directory: str | Path, config: Config | None = None, seed: int | None = None
    ) -> None:
        """`config` replaces the session's own `config.toml`; `seed` replaces `filter.seed`.

        Raises:
            SetupError: a file named by the configuration cannot be used.
            ConfigError: the configuration has faults.
        """
        self.directory = Path(directory)
        config = config or session.config_of(self.directory)
        if seed is not None:
            config = replace(config, filter=replace(config.filter, seed=seed))
        self.pipeline = open_pipeline(self.directory, config)
        self.config = self.pipeline.config
        self.names = bundle.names(config.scene)  # of objects, by their numbers in estimates
        self.layout = self.pipeline.skin.layout
        self.patches = [
            Patches(stage.skin.layout, stage.config.skin.full_scale_depth_m)
            for stage in self.pipeline.stages
        ]
        self._outcomes = outcomes(self.directory, self.pipeline)

    def __iter__(self) -> Iterator[Outcome]:
        """The outcome of each scan: estimate, activation, and sensor pose.

        Raises:
            SetupError: the session cannot be read, or is damaged.
        """
        return self._outcomes

    @property
    def model(self) -> ObservationModel:
        """Of the first object."""
        return self.pipeline.estimator.model

    def contacts(self, outcome: Outcome, seq: int) -> dict[str, Any]:
        """The map of `/taxeld/contacts` of the last scan, which was felt."""
        felt, link = outcome.activation, outcome.link
        patches, t = self.patches[link], outcome.estimate.t
        if felt is not None:
            patches.on_scan(felt.z)
            t = felt.t
        return messages.contacts(t, patches, outcome.sensor, seq, link)

    @property
    def belief(self) -> tuple[Poses, Floats]:
        """Particles (N, 3) and their weights (N,), of sum 1, after the last scan."""
        belief = self.pipeline.estimator.rule.belief
        return belief.pose.copy(), belief.weight.copy()

    def why(self, estimate: Estimate) -> Why:
        """Why the daemon would not mark this estimate, the last one, as valid."""
        return self.pipeline.freshness.why(estimate)

    def is_valid(self, estimate: Estimate) -> bool:
        """Whether the daemon would mark this estimate, the last one, as valid."""
        return self.why(estimate) is Why.VALID


def replay(directory: Path, config: Config, seed: int | None = None) -> Iterator[str]:
    """One JSON line a scan: the map of `/taxeld/estimate`, or of `/taxeld/contacts` where there is
    no object. The same input and seed give the same bytes on one machine and one build.

    Raises:
        SetupError: the session, or a file named by the configuration, cannot be used.
    """
    recorded = Replay(directory, config, seed)
    for seq, outcome in enumerate(recorded):
        if not recorded.names:
            yield json.dumps(recorded.contacts(outcome, seq), separators=(",", ":"))
            continue
        why = recorded.why(outcome.estimate)
        message = messages.estimate(
            outcome.estimate,
            names=recorded.names,
            seq=seq,
            why=why,
            links=recorded.pipeline.freshness.of_links(),
        )
        yield json.dumps(message, separators=(",", ":"))


def open_pipeline(directory: Path, config: Config) -> Pipeline:
    """The pipeline of a session. It has a sensor pose if one was recorded, whatever endpoint is
    configured, and takes the bundle's first choice for `auto`, whatever it costs here.

    Raises:
        SetupError: a file named by the configuration cannot be used.
    """
    where = str(directory) if session.has_poses(directory) else ""
    config = replace(config, sensor_pose=replace(config.sensor_pose, endpoint=where))
    try:
        for one in config.each:
            layouts.load(one.skin.layout)
        for name in config.scene.names:
            bundle.find(name, "scene.bundles" if config.scene.bundles else bundle.KEY)
    except SetupError as error:
        raise SetupError(
            f"{error}; a session does not hold its layout and its bundle: name them in "
            f"{directory / session.CONFIG}, by whole paths, or in another file with --config"
        ) from None
    begun = session.begun(directory) if any(one.skin.calibration for one in config.each) else 0.0
    return prepared(config, begun, recorded=True).pipeline


def outcomes(directory: Path, pipeline: Pipeline) -> Iterator[Outcome]:
    """The outcome of each scan of a session.

    Raises:
        SetupError: the session cannot be read, or its modules' order is unknown.
    """
    config, streams, firsts = pipeline.config, [], list[float]()
    for source, numbers in config.buses:
        place = _place(directory, config, numbers[0])
        if numbers[0] and not place.is_dir():  # nothing came from this link
            continue
        own = [pipeline.stages[k].skin.layout for k in numbers]
        recorded = session.read(place)
        streams.append(_ordered(recorded.poses, numbers[0]))
        for k in numbers[1:]:
            path = _place(directory, config, k) / session.POSES
            streams.append(_ordered(session.read_poses(path) if path.exists() else (), k))
        if recorded.items:  # else the session was cut before its first record
            firsts.append(recorded.items[0].t)
            decoder = module_order.recorded(source, joint(own), recorded.items, str(place))
            bus = Bus(Source(Wire(decoder)), numbers, own)
            streams.append(_ordered(recorded.items, bus))
    if not firsts:
        return
    before = 0, min(firsts)
    # as the daemon does: poses up to the arrival of a scan's last frame are known
    for now, came, of in heapq.merge(*streams, key=itemgetter(0)):
        if now[0] > before[0]:
            pipeline.clock_stepped(now[1] - before[1])
        before = now
        scans: list[list[Scan]] = [[] for _ in pipeline.stages]
        if isinstance(of, Bus) and isinstance(came, Item):
            for heard in of.source.wire.take([came]):
                of.sort(heard.scans, scans)
            yield from pipeline.advance(scans[0], now[1], *scans[1:])
        elif isinstance(of, int) and not isinstance(came, Item):
            yield from pipeline.advance((), now[1])
            pipeline.stages[of].poses.add(*came)
    yield from pipeline.advance((), math.inf)


def _place(directory: Path, config: Config, link: int) -> Path:
    """Where a link's records are: a further link has a folder of its name."""
    return directory / config.names[link] if link else directory


def _ordered(
    arrivals: Iterable[Arrival], of: int | Bus
) -> Iterator[tuple[tuple[int, float], Arrival, int | Bus]]:
    """Arrivals `of` a link or a bus with their keys of order: the number of earlier steps back of
    the clock, and the time.

    Only a step back shows in a recording: a step forward looks like a pause.
    """
    steps, before = 0, -math.inf
    for came in arrivals:
        t = came.t if isinstance(came, Item) else came[0]
        steps += is_step(min(t - before, 0.0))
        before = t
        yield (steps, t), came, of
