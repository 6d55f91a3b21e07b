"""The configuration of the daemon that a scenario is run with."""

from dataclasses import replace
from pathlib import Path

from taxeld import config
from taxeld.config import Config
from taxeld_hil.scenario import Scenario

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
[publish]
endpoints = ["ipc://{place}/stream"]
[control]
endpoint = "ipc://{place}/control"
"""


def text(scenario: Scenario, seed: int, channel: str, poses: str, place: Path) -> str:
    """The file: sockets and the skin's state are kept in `place`."""
    return TEXT.format(
        layout=scenario.layout,
        full_scale_counts=scenario.full_scale_counts,
        source=SOURCES[scenario.transport].format(channel=channel),
        bundle=scenario.bundle,
        poses=poses,
        seed=seed,
        place=place,
    )


def on_a_fake_clock(scenario: Scenario, seed: int, rate_hz: float) -> Config:
    """The same for a daemon that has no sockets, files and devices."""
    nowhere = Path("/nowhere")
    parsed = config.parse(text(scenario, seed, "memory", f"ipc://{nowhere}/poses", nowhere))
    return replace(parsed, loop=replace(parsed.loop, rate_hz=rate_hz))
