"""How an experiment is run: its options, its jobs under them, and the file that its rows go to."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from taxeld_training.jobs import jobs
from taxeld_training.jobs.jobs import Job
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
    groups: tuple[str, ...] = ()  # of samplers, or proposals
    cells: tuple[str, ...] = ()  # of the stability map
    until: float = math.inf  # of the monotonic clock: what has not begun by then is left out
    effort: float = 1.0  # share of each model's own training
    seeds: int = 0  # trials a cell of the filter's experiments
    seed: int = 0
    add: bool = False  # to the rows that the experiment's file holds


def run_jobs(todo: Sequence[Job], options: Options) -> dict[str, Any]:
    """Results by job name, as `jobs.run` has it."""
    return jobs.run(
        todo, options.memory, workers=options.workers, dask=options.dask, until=options.until
    )


def write(options: Options, name: str, rows: Sequence[Row]) -> Path:
    """Rows as the experiment's JSON file, a row a line: a diff can be read."""
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / f"{name}.json"
    lines = ",\n".join(json.dumps(row) for row in rows)
    path.write_text(f"[\n{lines}\n]\n", encoding="utf-8")
    return path
