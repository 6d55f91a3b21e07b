"""What a run needs beside devices and files: layouts, bundles, and the pipeline made of them."""

import hashlib
import time
from dataclasses import asdict, dataclass

from taxeld.config.tables import Config
from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld.pipeline.pipeline import Pipeline
from taxeld.proposals import bundle, choice
from taxeld.proposals.bundle import Bundle
from taxeld.service import calibration_file
from taxeld.source.recorder import Recorder


@dataclass(frozen=True, slots=True)
class Prepared:
    """The parts of a run that nothing has come to yet."""

    config: Config  # with as many particles and samples as the bundles need
    layouts: list[Layout]  # of each link
    bundles: list[Bundle]  # of each object
    pipeline: Pipeline


def prepared(config: Config, recorder: Recorder | None) -> Prepared:
    """All parts; `recorder` gets the sensor's poses.

    Raises:
        SetupError: one of them cannot be used.
    """
    skins = [layouts.load(one.skin.layout) for one in config.each]
    bundles = bundle.load_all(config.scene, skins, config.skin.full_scale_depth_m)
    config = bundle.sized(config, [one.manifest for one in bundles])
    pipeline = Pipeline(
        config,
        skins,
        [one.model for one in bundles],
        choice.samples(bundles, config.filter, time.perf_counter_ns),
        [recorder.of(k).pose for k in range(len(skins))] if recorder else (),
        [
            calibration_file.load(one.skin, layout, time.time())
            for one, layout in zip(config.each, skins, strict=True)
        ],
    )
    pipeline.thinks_at_once = False
    return Prepared(config, skins, bundles, pipeline)


def digest(config: Config) -> str:
    """Of all keys, whoever sets them; of links only where they are used."""
    used = {"links": config.links, "is_sized": False}
    given = {name: value for name, value in asdict(config).items() if used.get(name, True)}
    return hashlib.sha256(repr(given).encode()).hexdigest()[:16]
