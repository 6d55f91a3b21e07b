"""What the door is told, as text on its command line, and what the kernel lets it use."""

import resource
from collections.abc import Sequence
from dataclasses import dataclass

REFUSED = 2  # exit status of a door that cannot serve
OOM_SCORE = 1000  # where memory is short, the door goes first, however little it has
MEMORY_BYTES = 192 << 20  # data of the process, stacks included
DESCRIPTORS = 16_384  # without one left ZeroMQ ends the process
LIMITS = {
    resource.RLIMIT_DATA: MEMORY_BYTES,
    resource.RLIMIT_NOFILE: DESCRIPTORS,
    resource.RLIMIT_MEMLOCK: 0,
    resource.RLIMIT_FSIZE: 0,
    resource.RLIMIT_CORE: 0,
    resource.RLIMIT_RTPRIO: 0,
}


@dataclass(frozen=True, slots=True)
class Settings:
    """Endpoints, and who may use them; an empty one is not served, or not heard."""

    publish: Sequence[str] = ()
    control: str = ""
    is_relay: bool = (
        False  # the two are of TCP, else of ipc: peers over TCP have a door of their own
    )
    change: bool = False  # whether changes are taken over TCP
    change_group: str = ""  # its members may change something by ipc
    robot: str = ""  # where the sensor's poses come from
    topics: Sequence[str] = ()  # of the links' poses, where there are several
    array: str = ""  # where arrays come from
    queue: int = 40  # messages that wait for a slow subscriber
    estimates: bool = True  # there is an object, of which estimates are published
    keys: str = ""  # directory of CURVE's keys; empty: none

    @property
    def is_needed(self) -> bool:
        """Whether there is anything to serve or to hear, or keys that must be looked at."""
        looked_at = self.keys and not self.is_relay
        return any((*self.publish, self.control, self.robot, self.array, looked_at))


def limit() -> None:
    """Have the kernel end the door, and nothing else, where it uses more."""
    for what, most in LIMITS.items():
        hard = resource.getrlimit(what)[1]
        least = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(what, (least, least))


def start_no_more() -> None:
    """No further thread or process; of root the kernel does not ask this."""
    resource.setrlimit(resource.RLIMIT_NPROC, (0, 0))
