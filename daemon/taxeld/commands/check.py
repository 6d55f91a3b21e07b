"""`taxeld check`: whether everything that a run needs is there, without disturbing any of it."""

from pathlib import Path

from taxeld.config.endpoints import no_directory
from taxeld.config.tables import Config, SourceConfig
from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.proposals import bundle, choice
from taxeld.service import metrics
from taxeld.source import dialects, session
from taxeld.source.module_order import Recorded
from taxeld.stream import curve

SYS_NET = Path("/sys/class/net")


def faults(config: Config) -> list[str]:
    """One path-qualified line a fault of a configuration whose keys are fine."""
    found = []
    try:
        skin = layouts.load(config.skin.layout)
    except SetupError as error:
        found.append(str(error))
    else:
        try:
            dialects.live(config.source, skin)
            loaded = bundle.load(config.scene.bundle, skin, config.skin.full_scale_depth_m)
            choice.open_all(loaded, config.filter)
        except SetupError as error:
            found.append(str(error))
    try:
        _source(config.source)
    except SetupError as error:
        found.append(str(error))
    for keys in (curve.robot_keys, curve.relay_keys):
        try:
            keys(config)
        except SetupError as error:
            found.append(str(error))
            break  # a pair that cannot be used is both's
    try:
        metrics.place(config.metrics)
    except SetupError as error:
        found.append(str(error))
    for key, endpoints in (
        ("publish.endpoints", config.publish.endpoints),
        ("control.endpoint", (config.control.endpoint,)),
    ):
        for endpoint in endpoints:
            missing = no_directory(endpoint)
            if missing:
                found.append(f"{key}: {missing}")
    return found


def _source(source: SourceConfig) -> None:
    if source.kind == "replay":
        recorded = session.read(Path(source.path))
        if source.dialect == "cyskin":
            Recorded(source, recorded.items, source.path).check()
    elif source.kind == "serial" or source.interface == "slcan":
        device = Path(source.channel.split("@")[0])
        if not device.exists():
            raise SetupError(f"source.channel: no device {device}; is it plugged in?")
    elif source.interface == "socketcan" and not (SYS_NET / source.channel).exists():
        raise SetupError(
            f"source.channel: no CAN interface '{source.channel}'; "
            f"bring it up: ip link set {source.channel} up type can bitrate {source.bitrate}"
        )
