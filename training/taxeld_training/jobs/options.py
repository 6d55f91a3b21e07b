"""How an experiment is run: its options, its jobs under them, and the file that its rows go to."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from taxeld.errors import SetupError
from taxeld_hil import jobs
from taxeld_hil.jobs import Job
from taxeld_training.jobs.rows import Row


@dataclass(frozen=True)
class Options:
    """How an experiment is run; what is empty or 0 is the experiment's own."""

    out: Path
    memory: Path
    objects: tuple[str, ...] = ()
    columns: tuple[int, ...] = ()
    skin: str = ""  # another layout instead of the rings
    quick: bool = False
    workers: int = 2
    dask: str = ""
    groups: tuple[str, ...] = ()  # samplers by their group, or filters by their proposal
    cells: tuple[str, ...] = ()  # factors and levels of the table of conditions
    until: float = math.inf  # monotonic clock [s]: jobs that have not begun by then are left out
    effort: float = 1.0  # share of each model's own training
    seeds: int = 0  # trials a cell of the filter's experiments
    seed: int = 0


def run_jobs(todo: Sequence[Job], options: Options) -> dict[str, Any]:
    """Results by job name, as `jobs.run` has it; torch has one thread in each job."""
    return jobs.run(
        todo,
        options.memory,
        workers=options.workers,
        dask=options.dask,
        until=options.until,
        prepare=_one_thread,
    )


def with_file(job: Job, memory: Path, suffix: str) -> Job:
    """The job with the path of a file that it makes as its last argument. Where the file is missing
    the job is forgotten, so that it runs again."""
    path = memory.resolve() / f"{job.key}{suffix}"
    if not path.is_file():
        jobs.forget(job, memory)
    return replace(job, beside=(str(path),))


def write(options: Options, name: str, rows: Sequence[Row]) -> Path:
    """Rows as the experiment's JSON file, a row a line: a diff can be read.

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


def _one_thread() -> None:
    torch.set_num_threads(1)
