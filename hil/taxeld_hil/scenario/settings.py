"""The configuration of the daemon that a scenario is run with."""

from dataclasses import replace
from pathlib import Path

from taxeld.config import file as config_file
from taxeld.config.tables import Config
from taxeld_hil.scenario.scenario import Scenario

SOURCES = {
    "slcan": 'kind = "can"\ninterface = "slcan"\nchannel = "{channel}"',
    "can": 'kind = "can"\nchannel = "{channel}"',
    "native": 'kind = "serial"\nchannel = "{channel}"',
}

TEXT = """\
[skin]
layout = "{layout}"
full_scale_counts = {full_scale_counts}
state_dir = "{place}/state"
[source]
{source}
[scene]
bundle = "{bundle}"
[sensor_pose]
endpoint = "{poses}"
[filter]
seed = {seed}
{filter_keys}
[publish]
endpoints = ["ipc://{place}/stream"]
[control]
endpoint = "ipc://{place}/control"
"""


def text(
    scenario: Scenario, seed: int, channel: str, poses: str, place: Path, filter_keys: str = ""
) -> str:
    """The file: sockets and the skin's state are kept in `place`; `filter_keys` are more lines of
    the table [filter]."""
    return TEXT.format(
        layout=scenario.layout,
        full_scale_counts=scenario.full_scale_counts,
        source=SOURCES[scenario.transport].format(channel=channel),
        bundle=scenario.bundle,
        poses=poses,
        seed=seed,
        filter_keys=filter_keys,
        place=place,
    )


def on_a_fake_clock(
    scenario: Scenario, seed: int, filter_keys: str = "", rate_hz: float = 100.0
) -> Config:
    """The configuration of a daemon without sockets, files and devices.

    Raises:
        SetupError: faults in `filter_keys`.
    """
    nowhere = Path("/nowhere")
    file = text(scenario, seed, "memory", f"ipc://{nowhere}/poses", nowhere, filter_keys)
    parsed = config_file.parse(file)
    return replace(parsed, loop=replace(parsed.loop, rate_hz=rate_hz))
