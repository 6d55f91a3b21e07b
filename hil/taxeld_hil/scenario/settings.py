"""The configuration of the daemon that a scenario is run with."""

import json
from pathlib import Path
from typing import Any

from taxeld.config.tables import SensorPoseConfig
from taxeld.proposals import bundle
from taxeld_hil.scenario.scenario import Scenario


def text(scenario: Scenario, seed: int, channel: str, poses: str, place: Path) -> str:
    """The file: sockets and the skin's state are kept in `place`."""
    several = scenario.links > 1
    tables = [
        ("[[skin]]" if several else "[skin]", _skin(scenario, number, channel, place))
        for number in range(scenario.links)
    ]
    known = {"bundles": scenario.known} if scenario.bundles else {"bundle": scenario.bundle}
    # the daemon is told how far the robot errs
    robot = {"endpoint": poses, "sigma_m": scenario.robot_m or SensorPoseConfig().sigma_m}
    tables += [
        ("[source]", _source(scenario.transport, channel)),
        ("[scene]", known),
        ("[sensor_pose]", robot),
        ("[publish]", {"endpoints": [f"ipc://{place}/stream"]}),
        ("[control]", {"endpoint": f"ipc://{place}/control"}),
        ("[filter]", {"seed": seed}),
    ]
    if scenario.advised:
        tables[-1][1]["half_width_m"] = scenario.place_m
    lines = [
        line
        for name, keys in tables
        for line in (name, *(f"{key} = {_value(value)}" for key, value in keys.items()))
    ]
    return "\n".join([*lines, ""])


def _skin(scenario: Scenario, number: int, channel: str, place: Path) -> dict[str, Any]:
    keys: dict[str, Any] = {
        "layout": scenario.of_link(number).skin_layout,
        "full_scale_counts": scenario.full_scale_counts,
        "full_scale_depth_m": bundle.manifest_of(scenario.bundle).depth_max_m,
        "state_dir": f"{place}/state",
    }
    if number:
        keys["sensor_pose"] = {"topic": f"/robot/link{number + 1}_pose"}
        if not scenario.one_bus:
            keys["source"] = _source(scenario.transport, f"{channel}{number + 1}")
    return keys


def _source(transport: str, channel: str) -> dict[str, str]:
    if transport == "array":
        return {"kind": "array", "endpoint": f"ipc://{Path(channel).absolute()}"}
    if transport == "native":
        return {"kind": "serial", "channel": channel}
    interface = {"interface": "slcan"} if transport == "slcan" else {}
    return {"kind": "can", **interface, "channel": channel}


def _value(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {_value(each)}" for key, each in value.items()) + "}"
    return json.dumps(value, ensure_ascii=False)
