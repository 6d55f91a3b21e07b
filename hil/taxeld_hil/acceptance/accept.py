"""`taxeld-hil accept`: whether a real skin is fit for use, by a recording (docs/calibration.md)."""

from dataclasses import replace
from pathlib import Path

from taxeld.commands.replay import open_pipeline, sources_of
from taxeld.config.tables import Config, SceneConfig
from taxeld.errors import SetupError
from taxeld.source import session
from taxeld_hil.acceptance.checks import rules
from taxeld_hil.acceptance.recorded import RecordedSkin
from taxeld_hil.rules import Rule


def of_session(directory: Path, layout: str) -> list[Rule]:
    """The rules on the skins of all links of a session. `layout`: in place of the configuration's;
    empty: that.

    Raises:
        SetupError: the session or a layout cannot be used.
    """
    config = session.config_of(directory)
    if layout and config.links:
        raise SetupError("--layout: there are several links: name their layouts in config.toml")
    skin = replace(config.skin, layout=layout or config.skin.layout, calibration="")
    links = tuple(replace(link, calibration="") for link in config.links)
    bare = replace(config, skin=links[0] if links else skin, links=links, scene=SceneConfig())
    found = zip(config.names, recorded(directory, bare), strict=True)
    return [
        rule._replace(what=f"{name}, {rule.what}" if name else rule.what)
        for name, got in found
        for rule in rules(got)
    ]


def recorded(directory: Path, config: Config) -> list[RecordedSkin]:
    """What a session has of the skin of each link. Raises SetupError."""
    pipeline, end_t = open_pipeline(directory, config), 0.0
    found = [RecordedSkin(stage.skin, stage.config.source.period_ms) for stage in pipeline.stages]
    sources = sources_of(directory, pipeline)
    for record in session.records(directory):
        end_t = record.t
        for source in sources:
            for scan in source.take(record):
                found[scan.link].take(scan)
    for source, (_, numbers) in zip(sources, config.buses, strict=True):
        for k in numbers:
            found[k].end(end_t, source.decoder)
    return found
