"""Jobs of an experiment: they run side by side, are remembered, and show their progress.

A job is a function and its arguments. Its result is JSON, kept in a file of its own, so that an
experiment cut short goes on where it stopped.
"""

import contextlib
import hashlib
import json
import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import joblib
import torch
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from taxeld.command_line import ONE_THREAD
from taxeld.errors import SetupError

PATIENCE = "10s"  # with a scheduler


@dataclass(frozen=True)
class Job:
    """`work(*arguments, *beside)` → something that JSON can hold; arguments must have a stable
    `repr`."""

    name: str  # for the display, and part of the file's name
    work: Callable[..., Any]
    arguments: tuple[Any, ...]
    beside: tuple[Any, ...] = ()  # more arguments, on which the result does not depend: paths

    @property
    def key(self) -> str:
        """The name of the result's file, which differs for other arguments."""
        text = f"{self.work.__module__}.{self.work.__qualname__}{self.arguments!r}"
        return f"{self.name}-{hashlib.sha256(text.encode()).hexdigest()[:12]}"


def run(
    jobs: Sequence[Job],
    memory: Path,
    *,
    workers: int = 2,
    dask: str = "",
    until: float = math.inf,
    quiet: bool = False,
) -> dict[str, Any]:
    """Results by job name; those that `memory` holds are not run again.

    Each worker has one thread. With `dask`, the address of a running scheduler, the jobs run on its
    workers. No job begins after `until` (monotonic clock [s]); the result of a job that did not run
    is None. On an interrupt the results so far are kept and the interrupt goes on.

    Raises:
        SetupError: no such scheduler answers.
    """
    memory.mkdir(parents=True, exist_ok=True)
    results = {job.name: read(job, memory) for job in jobs}
    todo = [job for job in jobs if results[job.name] is None]
    columns = (
        TextColumn("{task.description:38s}"), BarColumn(), MofNCompleteColumn(),
        TimeElapsedColumn(),
    )  # fmt: skip
    with Progress(*columns, disable=quiet) as bar, _backend(dask):
        task = bar.add_task("starting", total=len(jobs), completed=len(jobs) - len(todo))
        parallel = joblib.Parallel(
            -1 if dask else min(workers, max(len(todo), 1)),
            return_as="generator_unordered",
            pre_dispatch="n_jobs",  # no job is dispatched before a worker is free
        )
        in_time = (joblib.delayed(_work)(job) for job in todo if time.monotonic() < until)
        for name, key, result in parallel(in_time):
            results[name] = result
            _write(memory / f"{key}.json", result)
            bar.update(task, advance=1, description=name)
    return results


def read(job: Job, memory: Path) -> Any:
    """The remembered result of a job; None without one."""
    try:
        return json.loads((memory / f"{job.key}.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def forget(job: Job, memory: Path) -> None:
    """Forget a job's result, as a file that it made beside it is missing."""
    (memory / f"{job.key}.json").unlink(missing_ok=True)


def _work(job: Job) -> tuple[str, str, Any]:
    torch.set_num_threads(1)
    return job.name, job.key, job.work(*job.arguments, *job.beside)


def _write(path: Path, result: Any) -> None:
    part = path.with_suffix(".part")
    part.write_text(json.dumps(result), encoding="utf-8")
    part.replace(path)  # whole or not at all


@contextlib.contextmanager
def _backend(dask: str) -> Iterator[None]:
    for name in ONE_THREAD:
        os.environ.setdefault(name, "1")  # inherited by the workers
    if not dask:
        yield
        return
    try:
        from distributed import Client  # noqa: PLC0415
    except ImportError:
        raise SetupError(
            "--dask: distributed is not installed; pip install 'taxeld[dask]'"
        ) from None
    try:
        client = Client(dask, timeout=PATIENCE)
    except (OSError, ValueError) as error:
        raise SetupError(f"--dask: no scheduler answers at {dask} ({error})") from None
    with client, joblib.parallel_config("dask"):
        yield
