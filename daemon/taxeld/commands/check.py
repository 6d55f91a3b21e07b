"""`taxeld check`: whether everything that a run needs is there, without disturbing any of it."""

from pathlib import Path

from taxeld.commands import openings
from taxeld.config.tables import Config, SourceConfig
from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.proposals import bundle, choice
from taxeld.service import calibration_file
from taxeld.source import dialects, session
from taxeld.source.session import Items
from taxeld.stream import client, curve

MODULES_TO_COME = (
    "source.modules: lists none, so taxeld must listen already when the skin is started, to hear "
    "which modules its hub has"
)

POSES_USUAL = "tcp://127.0.0.1:9874"  # address in the documents and examples
HEAR_POSES_S = 0.3
POSES_UNUSED = (
    f"sensor_pose.endpoint: is empty, so the sensor is taken to stand still; but a robot publishes "
    f'its poses at {POSES_USUAL}: set endpoint = "{POSES_USUAL}" if the sensor is on it'
)


def faults(config: Config, is_running: bool = False) -> list[str]:
    """Lines on the faults of a configuration with valid keys, each with its path. While a daemon
    `is_running` with the configuration, a device or endpoint in use is no fault."""
    found = []
    recorded, away = _source(config.source)
    try:
        skin = layouts.load(config.skin.layout)
    except SetupError as error:
        found.append(str(error))
    else:
        try:
            if config.source.kind != "replay":
                dialects.live(config.source, skin)
            elif not away:
                dialects.check_recording(config.source, skin, recorded, config.source.path)
            loaded = bundle.load(config.scene.bundle, skin, config.skin.full_scale_depth_m)
            choice.open_all(loaded, config.filter)
        except SetupError as error:
            found.append(str(error))
        try:
            calibration_file.of(config, skin)
        except SetupError as error:
            found.append(str(error))
    found += away
    try:
        keys = config.curve.directory
        curve.robot_keys(keys, config.sensor_pose.endpoint)
        curve.relay_keys(keys, (*config.relay.publish, config.relay.control))
    except SetupError as error:
        found.append(str(error))
    for key, endpoints in (
        ("publish.endpoints", config.publish.endpoints),
        ("control.endpoint", (config.control.endpoint,)),
    ):
        for endpoint in endpoints:
            fault = openings.closed(endpoint, key)
            if fault is None and not is_running:
                fault = openings.served(endpoint, key)
            found += [fault] if fault else []
    if config.source.kind != "replay" and not away and not is_running:
        busy = openings.taken(config.source)
        found += [busy] if busy else []
    return found


def notes(config: Config) -> list[str]:
    """Lines on matters that no check can decide."""
    source = config.source
    if source.kind == "replay":
        return []
    down = openings.down(source)
    found = [down] if down else []
    if not config.sensor_pose.endpoint and client.hears_poses(POSES_USUAL, HEAR_POSES_S):
        found.append(POSES_UNUSED)
    if source.dialect != "icub":
        return [*found, MODULES_TO_COME] if source.listen_only and not source.modules else found
    return [
        *found,
        f"source.channel: the boards must hang on {source.channel} itself; behind an Ethernet "
        "board (EMS), as on most iCubs, they cannot be reached over CAN",
    ]


def _source(source: SourceConfig) -> tuple[Items, list[str]]:
    """The items of a session, and lines on why the source cannot be opened."""
    if source.kind != "replay":
        away = openings.absent(source)
        return [], [away] if away else []
    try:
        return session.read(Path(source.path)).items, []
    except SetupError as error:
        return [], [str(error)]
