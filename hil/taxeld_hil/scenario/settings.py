"""The configuration of the daemon that a scenario is run with."""

from pathlib import Path

from taxeld.advice.lines import Reach
from taxeld.config.tables import SensorPoseConfig
from taxeld.proposals import bundle
from taxeld_hil.scenario.scenario import Scenario

SOURCES = {
    "slcan": 'kind = "can"\ninterface = "slcan"\nchannel = "{channel}"',
    "can": 'kind = "can"\nchannel = "{channel}"',
    "native": 'kind = "serial"\nchannel = "{channel}"',
    "array": 'kind = "array"\nendpoint = "{ipc}"',
}

SKIN = """\
layout = "{layout}"
full_scale_counts = {full_scale_counts}
full_scale_depth_m = {full_scale_depth_m}
state_dir = "{place}/state"
"""

TEXT = """\
{skins}[source]
{source}
[scene]
{objects}
[sensor_pose]
endpoint = "{poses}"
sigma_m = {sigma_m}
[filter]
seed = {seed}
{filter_keys}
{advised}[publish]
endpoints = ["ipc://{place}/stream"]
[control]
endpoint = "ipc://{place}/control"
"""


REACH = Reach(box_m=(-0.6, 0.6, -0.6, 0.6))  # of an advised robot
ADVISED = "half_width_m = {place_m}\n"


def text(
    scenario: Scenario, seed: int, channel: str, poses: str, place: Path, filter_keys: str = ""
) -> str:
    """The file: sockets and the skin's state are kept in `place`; `filter_keys` are more lines of
    the table [filter]."""
    several, (first, *_) = ", ".join(f'"{name}"' for name in scenario.known), scenario.known
    return TEXT.format(
        skins=_skins(scenario, channel, place),
        source=SOURCES[scenario.transport].format(channel=channel, ipc=array_at(channel)),
        objects=f"bundles = [{several}]" if scenario.bundles else f'bundle = "{first}"',
        poses=poses,
        sigma_m=scenario.robot_m or SensorPoseConfig().sigma_m,  # the daemon is told
        seed=seed,
        filter_keys=filter_keys,
        advised=ADVISED.format(place_m=scenario.place_m) * scenario.advised,
        place=place,
    )


def _skins(scenario: Scenario, channel: str, place: Path) -> str:
    tables = [
        SKIN.format(
            layout=scenario.of_link(number).skin_layout,
            full_scale_counts=scenario.full_scale_counts,
            full_scale_depth_m=bundle.manifest_of(scenario.bundle).depth_max_m,
            place=place,
        )
        for number in range(scenario.links)
    ]
    if len(tables) == 1:
        return f"[skin]\n{tables[0]}"
    for number in range(1, len(tables)):
        tables[number] += f'sensor_pose = {{topic = "/robot/link{number + 1}_pose"}}\n'
        if not scenario.one_bus:
            source = SOURCES[scenario.transport].format(channel=f"{channel}{number + 1}", ipc="")
            tables[number] += f"source = {{{source.replace(chr(10), ', ')}}}\n"
    return "".join(f"[[skin]]\n{table}" for table in tables)


def array_at(channel: str) -> str:
    """The endpoint of an array that is sent in a port's place."""
    return f"ipc://{Path(channel).absolute()}"


def without_devices(scenario: Scenario, seed: int, filter_keys: str = "") -> str:
    """The file of a daemon without sockets, files and devices."""
    nowhere = Path("/nowhere")
    skin, poses = str(nowhere / "skin"), f"ipc://{nowhere}/poses"
    return text(scenario, seed, skin, poses, nowhere, filter_keys)
