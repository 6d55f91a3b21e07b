"""How an experiment is run: its options, its jobs under them, and the file that its rows go to."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from taxeld.errors import SetupError
from taxeld_hil import jobs
from taxeld_hil.jobs import Job

DECIDES = (  # code and bundles that decide the results of jobs
    "taxeld/config/tables.py",
    "taxeld/model/*.py",
    "taxeld/skin/foam.py",
    "taxeld/proposals/*.py",
    "taxeld/estimator/*.py",
    "taxeld/advice/*.py",
    "taxeld/bundles/*/bundle.json",  # each names the SHA-256 of all files beside it
    "taxeld_hil/scenario/mesh_config.py",
    "taxeld_hil/objects/*.py",
    "taxeld_hil/world/*.py",
    "taxeld_training/models/*.py",
    "taxeld_training/limits/*.py",
    "taxeld_training/filters/*.py",
)


@dataclass(frozen=True)
class Options:
    """How an experiment is run; an option that is empty or 0 is the experiment's own."""

    out: Path
    memory: Path
    objects: tuple[str, ...] = ()
    layouts: tuple[str, ...] = ("",)  # "": the rings
    quick: bool = False
    workers: int | str = 2  # of them, or the address of a Dask scheduler
    groups: tuple[str, ...] = ()  # filters by their proposal
    cells: tuple[str, ...] = ()  # factors and levels of the table of conditions
    until: float = math.inf  # monotonic clock [s]: jobs that have not begun by then are left out
    effort: float = 1.0  # share of each model's own training
    seeds: int = 0  # trials a cell of the filter's experiments
    seed: int = 0

    @property
    def measured(self) -> Path:
        """The part of the memory that holds results of today's code and bundles. Trained models
        stand beside it, in `memory` itself: they outlast a change of the code."""
        return self.memory / jobs.code(DECIDES)


def run_jobs(todo: Sequence[Job], options: Options, memory: Path | None = None) -> dict[str, Any]:
    """Results by job name, as `jobs.run` has it, remembered in `options.measured` or in another
    `memory`; torch has one thread in each job."""
    torch.set_num_threads(1)  # here; workers have it from their environment
    return jobs.run(
        todo,
        memory or options.measured,
        workers=options.workers,
        until=options.until,
    )


def with_file(job: Job, memory: Path, suffix: str) -> Job:
    """The job with the path of a file that it makes as its last argument. Where the file is missing
    the job is forgotten, so that it runs again."""
    path = memory.resolve() / f"{job.key}{suffix}"
    if not path.is_file():
        jobs.forget(job, memory)
    return replace(job, beside=(str(path),))


def check(option: str, names: Sequence[str], known: Sequence[str]) -> None:
    """Raises SetupError where an option names what there is not."""
    for name in names:
        if name not in known:
            raise SetupError(f"{option}: no '{name}' here; there are {', '.join(known)}")


def write(options: Options, name: str, rows: Sequence[Mapping[str, Any]]) -> Path:
    """Rows as the experiment's JSON file, a row a line so that a diff can be read; its path.

    Raises:
        SetupError: there are none, as time ran out or no group has any.
    """
    if not rows:
        raise SetupError("nothing was measured; give more --minutes, or other --groups")
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / f"{name}.json"
    lines = ",\n".join(json.dumps(row) for row in rows)
    path.write_text(f"[\n{lines}\n]\n", encoding="utf-8")
    return path
