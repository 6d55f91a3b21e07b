"""`taxeld-hil accept`: whether a real skin is fit for use, by a recording (docs/calibration.md)."""

from dataclasses import replace
from pathlib import Path

from taxeld.commands.replay import RecordedInputs, open_pipeline
from taxeld.config.tables import Config, SceneConfig
from taxeld.errors import SetupError
from taxeld.source import session
from taxeld.source.session import Pass
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
    inputs = RecordedInputs(directory, pipeline)
    for arrival in session.arrivals(directory):
        end_t = arrival.t
        inputs.take(arrival)
        for scan in inputs.scans() if isinstance(arrival.item, Pass) else ():
            found[scan.link].take(scan)
    for source in inputs.sources:
        for k in source.links.numbers:
            found[k].end(end_t, source.decoder)
    return found
