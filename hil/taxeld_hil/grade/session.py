"""What a run leaves in its session beside what the skin and the robot sent.

`published.msgpack` has the daemon's messages as a subscriber got them, each `[t, topic, body]` at
scenario time t. `run.json` says which run it was, with the scenario, its faults and the ledger of
what was sent; it is written last.
"""

import json
from array import array
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import msgpack
import numpy as np

from taxeld.config import gate
from taxeld.errors import SetupError
from taxeld.pipeline.freshness import Why
from taxeld.stream import messages, topics
from taxeld_hil.scenario.scenario import Scenario

PUBLISHED, RUN = "published.msgpack", "run.json"
KEYS = ("status", "why", "contacts", "object", "p", "radius_m", "t", "age_us")
POSE = ("x", "y", "theta")

Health = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Run:
    """Which run it was."""

    name: str
    seed: int
    clock: str  # fake, real; of a recording: replayed
    scenario: Scenario
    end_s: float  # scenario time
    taxels: Sequence[Sequence[int]]  # that each fault is about, as the layout numbers them
    not_injected: Sequence[str] = ()  # kinds of faults that were not possible
    ledger: dict[str, Any] | None = None  # `Ledger.entries`; None: of a recording
    growth_mb: float = 0.0  # of a daemon's memory, in real time

    def write(self, directory: Path) -> None:
        scenario = {**asdict(self.scenario), "mesh": self.scenario.mesh.keys}
        text = json.dumps({**asdict(self), "scenario": scenario}, indent=1)
        (directory / RUN).write_text(f"{text}\n", encoding="utf-8")


def read_run(directory: Path) -> Run:
    """The run of a session.

    Raises:
        SetupError: it is no session of a run, or that run did not end.
    """
    faults: list[str] = []
    try:
        values = json.loads((directory / RUN).read_text(encoding="utf-8"))
        scenario = gate.take(Scenario, values.pop("scenario"), faults)
    except (OSError, ValueError, LookupError) as error:
        raise SetupError(f"{directory / RUN}: no run ended here ({error})") from None
    if scenario is None:
        raise gate.ConfigError(faults)
    return Run(scenario=scenario, **values)


def add(published: BinaryIO, t: float, topic: bytes, body: bytes) -> None:
    """Append what a subscriber gets."""
    published.write(msgpack.packb((t, topic, body)))


class Reception(NamedTuple):
    """All that a subscriber got of a run, in order."""

    estimates: Any  # recarray (N,): `at` (scenario time), KEYS, POSE, stages, links
    health: list[tuple[float, Health]]

    def lost(self, link: int) -> Any:
        """(N,) whether one of several links did not work, whatever the others did."""
        name, e = f"link {link}", self.estimates
        return e[name] != Why.VALID if name in e.dtype.names else np.zeros(len(e), bool)


def read(directory: Path, links: int) -> Reception:
    """What was published; it takes some 200 bytes an estimate.

    Raises:
        SetupError: it cannot be read.
    """
    rows, health = array("d"), list[tuple[float, Health]]()
    try:
        with (directory / PUBLISHED).open("rb") as file:
            for at, topic, body in msgpack.Unpacker(file):
                if topic == topics.ESTIMATE:
                    rows.extend(row(at, msgpack.unpackb(body)))
                else:
                    health.append((at, msgpack.unpackb(body)))
    except (OSError, ValueError, msgpack.UnpackException) as error:
        raise SetupError(f"{directory / PUBLISHED}: cannot be read ({error})") from None
    return Reception(estimates(rows, links), health)


def estimates(rows: Any, links: int) -> Any:
    """The estimates (N,) of rows (N · columns,), as `row` has them."""
    of_links = [f"link {k}" for k in range(links if links > 1 else 0)]
    names = ["at", *KEYS, *POSE, *messages.STAGES, *of_links]
    return np.array(rows).view([(name, float) for name in names]).view(np.recarray)


def row(at: float, e: dict[str, Any]) -> list[float]:
    """An estimate's message at scenario time `at`."""
    pose, lat = (e["map"][key] for key in POSE), (e["lat_us"][key] for key in messages.STAGES)
    return [at, *(e[key] for key in KEYS), *pose, *lat, *e.get("links", ())]
