"""What a run leaves in its session beside what the skin and the robot sent.

`published.msgpack` has the daemon's messages as a subscriber got them, each `[t, topic, body]` at
scenario time t, and a killed process's return as `[t, kind of fault, b""]`. `run.json` says which
run it was, with the scenario, its faults and the ledger of what was sent; it is written last.
"""

import json
from array import array
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgpack
import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Bools, Floats, Poses
from taxeld.config import gate
from taxeld.errors import SetupError
from taxeld.pipeline.freshness import Why
from taxeld.stream import messages, topics
from taxeld_hil.scenario.scenario import Scenario

PUBLISHED, RUN = "published.msgpack", "run.json"

Health = dict[str, Any]
Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Run:
    """Which run it was."""

    name: str
    seed: int
    target: str  # sim, or the device
    clock: str  # fake, real
    scenario: Scenario
    end_s: float  # scenario time
    taxels: Sequence[Sequence[int]]  # that each fault is about, as the layout numbers them
    not_injected: Sequence[str] = ()  # kinds of faults that were not possible
    ledger: dict[str, Any] | None = None  # `Ledger.entries`; None: a real skin keeps none

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


class PublishedFile:
    """Appends what a subscriber gets."""

    def __init__(self, directory: Path) -> None:
        self._file = (directory / PUBLISHED).open("wb")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self._file.close()

    def add(self, t: float, topic: bytes, body: bytes) -> None:
        self._file.write(msgpack.packb((t, topic, body)))


@dataclass(frozen=True, slots=True)
class Reception:
    """All that a subscriber got of a run, in order: N estimates, and the health."""

    t: Floats  # (N,) scenario time of their arrival
    status: Ints  # (N,), and so on
    why: Ints
    contacts: Ints
    p: Floats
    radius_mm: Floats
    pose: Poses  # (N, 3) the likeliest
    object: Ints
    scan_t: Floats  # time of its scan, by whatever clock; 0: there was none yet
    age_ms: Floats  # of the scan
    lat_ms: dict[str, Floats]  # by stage
    lost: Bools  # (N, L) whether each of several links does not work, whatever the others do
    health: list[tuple[float, Health]] = field(default_factory=list)
    returns: list[tuple[float, str]] = field(default_factory=list)  # of killed processes

    @property
    def claimed(self) -> Floats:
        """`p`, or 0 where the estimate is not valid."""
        return np.where(self.why == Why.VALID, self.p, 0.0)


def read(directory: Path, links: int) -> Reception:
    """What was published; memory: some 150 bytes an estimate.

    Raises:
        SetupError: it cannot be read.
    """
    rows, health, returns = array("d"), list[tuple[float, Health]](), list[tuple[float, str]]()
    links = links if links > 1 else 0
    try:
        with (directory / PUBLISHED).open("rb") as file:
            for t, topic, body in msgpack.Unpacker(file):
                if topic == topics.ESTIMATE:
                    rows.extend(_row(t, msgpack.unpackb(body)))
                elif topic == topics.HEALTH:
                    health.append((t, msgpack.unpackb(body)))
                else:
                    returns.append((t, topic.decode()))
    except (OSError, ValueError, msgpack.UnpackException) as error:
        raise SetupError(f"{directory / PUBLISHED}: cannot be read ({error})") from None
    stages = messages.STAGES
    table = np.frombuffer(rows).reshape(-1, 12 + len(stages) + links).T
    status, why, contacts, of = table[1:5].astype(np.int64)
    return Reception(
        table[0],
        status,
        why,
        contacts,
        p=table[5],
        radius_mm=1e3 * table[6],
        pose=table[7:10].T,
        object=of,
        scan_t=table[10],
        age_ms=1e-3 * table[11],
        lat_ms=dict(zip(stages, 1e-3 * table[12:], strict=False)),
        lost=table[12 + len(stages) :].T != Why.VALID,
        health=health,
        returns=returns,
    )


def _row(t: float, e: dict[str, Any]) -> list[float]:
    of, pose = (e["status"], e["why"], e["contacts"], e["object"]), e["map"]
    where = (e["p"], e["radius_m"], pose["x"], pose["y"], pose["theta"])
    lat = (e["lat_us"][stage] for stage in messages.STAGES)
    return [t, *of, *where, e["t"], e["age_us"], *lat, *e.get("links", ())]
