"""What the door is told of the configuration, as text on its command line."""

import json
from dataclasses import asdict, dataclass
from typing import Self

OOM_SCORE = 1000  # where memory is short, the door goes first, however little it has


@dataclass(frozen=True, slots=True)
class Settings:
    """Endpoints, and who may use them."""

    publish: tuple[str, ...]  # ipc
    control: str  # ipc; empty: none
    change_group: str  # its members may tare and reset at `control`
    robot: str  # endpoint of the sensor's poses; empty: none
    queue: int  # messages that wait for a slow subscriber
    relay_publish: tuple[str, ...] = ()  # TCP
    relay_control: str = ""  # TCP; empty: none
    relay_change: bool = False  # tare and reset are taken there
    topics: tuple[str, ...] = ()  # of the links' poses, where there are several
    array: str = ""  # where arrays are heard; empty: nowhere
    estimates: bool = True  # there is an object, of which estimates are published
    keys: str = ""  # directory of CURVE's keys; empty: none

    @property
    def is_needed(self) -> bool:
        """Whether there is anything to serve or to hear, or keys that must be looked at."""
        named = (*self.publish, *self.relay_publish, self.control, self.relay_control)
        return any((*named, self.robot, self.array, self.keys))

    def dump(self) -> str:
        return json.dumps(asdict(self))

    @classmethod
    def parse(cls, text: str) -> Self:
        given = json.loads(text)
        lists = {name: tuple(given[name]) for name in ("publish", "relay_publish", "topics")}
        return cls(**given | lists)
