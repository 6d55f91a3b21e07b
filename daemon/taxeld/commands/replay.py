"""Replay of a session: the daemon's pipeline on recorded input, without a clock."""

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from taxeld.arrays import Floats, Poses
from taxeld.config.tables import Config, SourceConfig
from taxeld.errors import SetupError
from taxeld.estimator.estimate import Estimate
from taxeld.layout.layout import Layout
from taxeld.model.observation import ObservationModel
from taxeld.pipeline.freshness import Why
from taxeld.pipeline.pipeline import Outcome, Pipeline
from taxeld.proposals import bundle
from taxeld.service.prepare import prepared
from taxeld.skin.patches import Patches
from taxeld.source import modules, session
from taxeld.source.links import LinkTable, joint
from taxeld.source.session import Arrival, ClockStep, Head, Late, Pass, SensorPose
from taxeld.stream import messages
from taxeld_protocol.array import ArrayDecoder, ArrayFrame
from taxeld_protocol.decoder import Decoder, Scan
from taxeld_protocol.frames import Chunk, Frame


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

    @property
    def belief(self) -> tuple[Poses, Floats]:
        """Particles (N, 3) and their weights (N,), of sum 1, after the last scan."""
        belief = self.pipeline.estimator.belief.particles
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
    stages, links = recorded.pipeline.stages, recorded.pipeline.freshness.of_links
    skins = [Patches(one.skin.layout, one.config.skin.full_scale_depth_m) for one in stages]
    for seq, outcome in enumerate(recorded):
        e, felt, link = outcome.estimate, outcome.activation, outcome.link
        if recorded.names:
            why, names = recorded.why(e), recorded.names
            message = messages.estimate(e, names=names, seq=seq, why=why, links=links())
        else:
            if felt is not None:
                skins[link].on_scan(felt.z)
            t = e.t if felt is None else felt.t
            message = messages.contacts(t, skins[link], outcome.sensor, seq, link)
        yield json.dumps(message, separators=(",", ":"))


def open_pipeline(directory: Path, config: Config) -> Pipeline:
    """The pipeline of a session. It has a robot if the recorder had one, whatever endpoint is
    configured, and takes the bundle's first choice for `auto`, whatever it costs here.

    Raises:
        SetupError: the session is none, or a file named by the configuration cannot be used.
    """
    begun, head = session.head(directory)
    where = str(directory) if head.moves else ""
    config = replace(config, sensor_pose=replace(config.sensor_pose, endpoint=where))
    try:
        return prepared(config, begun, recorded=True).pipeline
    except SetupError as error:
        if not str(error).startswith(("skin.layout", "scene.bundle")):
            raise
        raise SetupError(
            f"{error}; a session does not hold its layout and its bundle: name them in "
            f"{directory / session.CONFIG}, by whole paths, or in another file with --config"
        ) from None


def outcomes(directory: Path, pipeline: Pipeline) -> Iterator[Outcome]:
    """The outcome of each scan of a session, which is never held whole.

    Raises:
        SetupError: the session cannot be read, or its modules' order is unknown.
    """
    inputs, t = RecordedInputs(directory, pipeline), 0.0
    for arrival in session.arrivals(directory):
        t, link, item = arrival
        match item:
            case Pass():
                yield from pipeline.advance(inputs.scans(), t)
            case ClockStep():
                pipeline.clock_stepped(item.by)
            case SensorPose() if link < len(pipeline.stages):
                pipeline.stages[link].poses.add(*item, t)
            case _:
                inputs.take(arrival)
    yield from pipeline.advance(inputs.scans(), t)
    yield from pipeline.advance((), math.inf)
    inputs.end()


class RecordedInputs:
    """The sources of a session, in the order of the configuration's buses."""

    def __init__(self, directory: Path, pipeline: Pipeline) -> None:
        """Raises SetupError where there is no session, or it cannot be of this configuration."""
        skins, shared = [stage.skin.layout for stage in pipeline.stages], pipeline.config.buses
        self._directory, (_, head) = directory, session.head(directory)
        self.sources = [
            RecordedSource(one, {k: skins[k] for k in numbers}, head, alone=len(shared) == 1)
            for one, numbers in shared
        ]
        self._scans: list[Scan] = []

    def take(self, arrival: Arrival) -> None:
        """Take what has come of a source."""
        for source in self.sources:
            if isinstance(arrival.item, Late) and source.has(arrival):
                own = source.links.numbers
                self._scans = [scan for scan in self._scans if scan.link not in own]
            self._scans += source.take(arrival)

    def scans(self) -> list[Scan]:
        """The scans that have come since they were last asked for."""
        scans, self._scans = self._scans, []
        return scans

    def end(self) -> None:
        """Raises SetupError where hubs sent scans, and the order of their modules is unknown."""
        for source in self.sources:
            if isinstance(source.decoder, Decoder) and (
                line := modules.unplaced(source.decoder, f" of {self._directory}")
            ):
                raise SetupError(line)


class RecordedSource:
    def __init__(
        self, config: SourceConfig, skins: Mapping[int, Layout], head: Head, *, alone: bool
    ) -> None:
        """`alone`: whether it is the only one."""
        self._alone = alone
        layout, self.links = joint(list(skins.values())), LinkTable(skins)
        self.decoder: Any
        if config.kind == "array":
            self.decoder = ArrayDecoder(layout.uid.tolist(), config.array)
        else:
            modules.check(config, layout)
            listed = head.listed(config, self.links.numbers[0])
            self.decoder = Decoder(modules.known(listed), config.period_ms / 1000.0)

    def take(self, arrival: Arrival) -> list[Scan]:
        """The scans that an arrival ends; none where it is another source's."""
        is_array = isinstance(self.decoder, ArrayDecoder)
        kinds = (ArrayFrame,) if is_array else (Frame, Chunk)
        if not (self.has(arrival) and isinstance(arrival.item, kinds)):
            return []
        if is_array:
            self.decoder.now_t = arrival.t
        decoded = self.decoder.take([arrival.item])
        return self.links.of(scan for _, scans in decoded for scan in scans)

    def has(self, arrival: Arrival) -> bool:
        return self._alone or arrival.link == self.links.numbers[0]
