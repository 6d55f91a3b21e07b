"""What a run needs beside devices: layouts, bundles, calibrations, and the pipeline of them."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

from taxeld.config.tables import Config
from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld.pipeline.pipeline import Pipeline
from taxeld.proposals import bundle, choice
from taxeld.proposals.bundle import Bundle
from taxeld.proposals.samples import ClockNs
from taxeld.service import calibration_file
from taxeld.service.surroundings import MACHINE

Load = Callable[[Config, Sequence[Layout]], list[Bundle]]


@dataclass(frozen=True, slots=True)
class Prepared:
    """The parts of a run that nothing has come to yet."""

    config: Config  # with as many particles and samples as the bundles need
    layouts: list[Layout]  # of each link
    bundles: list[Bundle]  # of each object
    pipeline: Pipeline


def prepared(
    config: Config,
    t: float,
    clock: ClockNs | None = None,
    *,
    load: Load = MACHINE.bundles,
    recorded: bool = False,
) -> Prepared:
    """All parts, for a start at Unix time `t`. With a `clock` [ns] samples are chosen by their cost
    on this machine. `load`: as `Surroundings.bundles`. What is `recorded` may be older than its
    calibration.

    Raises:
        SetupError: one of them cannot be used.
    """
    skins = [layouts.load(one.skin.layout) for one in config.each]
    calibrations = [
        calibration_file.load(one.skin, layout, t, recorded=recorded)
        for one, layout in zip(config.each, skins, strict=True)
    ]
    bundles = load(config, skins)
    config = bundle.sized(config, [one.manifest for one in bundles])
    samples = choice.samples(bundles, config.filter, clock)
    models = [one.model for one in bundles]
    pipeline = Pipeline(config, skins, models, samples, calibrations)
    for _, numbers in config.buses:
        wirings = [pipeline.stages[k].skin.wiring for k in numbers]
        for wiring in wirings:
            wiring.neighbours = {sui for each in wirings for sui in each.suis}
    return Prepared(config, skins, bundles, pipeline)


def digest(config: Config) -> str:
    """Of all keys, whoever sets them; of links only where they are used."""
    used = {"links": config.links, "is_sized": False}
    given = {name: value for name, value in asdict(config).items() if used.get(name, True)}
    return hashlib.sha256(repr(given).encode()).hexdigest()[:16]
