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
from taxeld.source.session import Record
from taxeld.stream import messages
from taxeld_protocol.array import ArrayDecoder, ArrayFrame
from taxeld_protocol.decoder import Decoder, Scan
from taxeld_protocol.frames import Chunk, Frame

OfSkin = Frame | Chunk | ArrayFrame


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
    """The pipeline of a session. It has a sensor pose if one was recorded, whatever endpoint is
    configured, and takes the bundle's first choice for `auto`, whatever it costs here.

    Raises:
        SetupError: a file named by the configuration cannot be used.
    """
    where = str(directory) if (directory / session.POSES).exists() else ""
    config = replace(config, sensor_pose=replace(config.sensor_pose, endpoint=where))
    begun = session.begun(directory) if any(one.skin.calibration for one in config.each) else 0.0
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
    stages, sources = pipeline.stages, sources_of(directory, pipeline)
    steps, before = 0, 0.0
    # as the daemon does: poses up to the arrival of a scan's last frame are known
    for record in session.records(directory):
        if record.steps > steps:
            pipeline.clock_stepped(record.t - before)
        steps, before = record.steps, record.t
        scans = [scan for source in sources for scan in source.take(record)]
        yield from pipeline.advance(scans, record.t)
        if not isinstance(record.item, OfSkin) and record.link < len(stages):
            stages[record.link].poses.add(*record.item)
    yield from pipeline.advance((), math.inf)
    for source in sources:
        source.end(str(directory))


def sources_of(directory: Path, pipeline: Pipeline) -> "list[RecordedSource]":
    """The sources of a session, in the order of the configuration's buses.

    Raises:
        SetupError: the session is of an older version.
    """
    config = pipeline.config
    for name in config.names[1:]:
        if (directory / name).is_dir():
            raise SetupError(
                f"{directory / name}: links no longer have folders of their own in a session; "
                "record it anew"
            )
    skins, shared = [stage.skin.layout for stage in pipeline.stages], config.buses
    return [
        RecordedSource(one, {k: skins[k] for k in numbers}, alone=len(shared) == 1)
        for one, numbers in shared
    ]


class RecordedSource:
    def __init__(self, config: SourceConfig, skins: Mapping[int, Layout], *, alone: bool) -> None:
        """`alone`: whether it is the only one."""
        self._is_array, self._alone = config.kind == "array", alone
        layout, self._links = joint(list(skins.values())), LinkTable(skins)
        self.decoder: Any
        if self._is_array:
            self.decoder = ArrayDecoder(layout.uid.tolist(), config.array)
        else:
            modules.check(config, layout)
            self.decoder = Decoder(modules.known(config.modules), config.period_ms / 1000.0)

    def take(self, record: Record) -> list[Scan]:
        """The scans that its record ends; none where the record is another source's."""
        decoded = self.decoder.take([record.item]) if self._has(record) else ()
        return self._links.of(scan for _, scans in decoded for scan in scans)

    def end(self, place: str) -> None:
        """Raises SetupError where hubs sent scans, and the order of their modules is unknown."""
        line = "" if self._is_array else modules.unplaced(self.decoder, f" of {place}")
        if line:
            raise SetupError(line)

    def _has(self, record: Record) -> bool:
        item = record.item
        if not isinstance(item, OfSkin) or isinstance(item, ArrayFrame) != self._is_array:
            return False
        return self._alone or self._is_array or record.link == self._links.numbers[0]
