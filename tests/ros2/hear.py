"""A reader in a process of its own: a JSON line for each message of the topics that are named.

python hear.py pose:PoseWithCovarianceStamped …
"""

import dataclasses
import json
import sys
import threading
from typing import Any

from taxeld_ros2 import ros_types
from taxeld_ros2.dds import RELIABLE, Participant, last, taken


def plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return value


def main(wanted: list[str]) -> None:
    came = threading.Event()
    dds = Participant()
    readers = {}
    for one in wanted:
        name, _, kind = one.partition(":")
        readers[name] = dds.reader(name, getattr(ros_types, kind), last(1000, RELIABLE), came.set)
    while True:
        came.wait(0.1)
        came.clear()
        for name, reader in readers.items():
            for message in taken(reader):
                print(json.dumps({"topic": name, "message": plain(message)}), flush=True)  # noqa: T201


if __name__ == "__main__":
    main(sys.argv[1:])
