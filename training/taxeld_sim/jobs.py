"""Jobs of an experiment: they run side by side, are remembered, and show their progress.

A job is a function and its arguments. Its result is JSON, kept in a file of its own, so that an
experiment cut short goes on where it stopped. Harness and training run theirs here, with the same
options.
"""

import contextlib
import functools
import hashlib
import json
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from importlib import resources
from multiprocessing import get_context, parent_process
from pathlib import Path
from typing import Any

from taxeld.command_line import ONE_THREAD, Argument, given
from taxeld.errors import SetupError

MEMORY = Path(".experiments")  # finished jobs; what was interrupted goes on from them
OWN = "own"  # `--layout` of what a row is of without that option
PATIENCE = "10s"  # longest wait for a Dask scheduler's answer
NAME_LENGTH = 60  # characters of a job's name in its file's name; a key's hash tells jobs apart


@dataclass(frozen=True)
class Job:
    """`work(*arguments, *beside)` → something that JSON can hold; arguments must have a stable
    `repr`."""

    name: str  # for the display, and part of the file's name; unique among the jobs of a run
    work: Callable[..., Any]
    arguments: tuple[Any, ...]
    beside: tuple[Any, ...] = ()  # more arguments, on which the result does not depend: paths
    code: str = ""  # hash of the code that the result depends on, beside the arguments

    @property
    def key(self) -> str:
        """The name of the result's file, which differs for other arguments."""
        text = f"{self.work.__module__}.{self.work.__qualname__}{self.arguments!r}{self.code}"
        name = self.name.replace("/", "-")[-NAME_LENGTH:]
        return f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:12]}"


@functools.cache
def code(decides: tuple[str, ...]) -> str:
    """Hash of the files that decide a result, as this process first found them; `decides` are
    patterns of their paths, which begin with a package."""
    found = hashlib.sha256()
    for pattern in decides:
        package, _, inside = pattern.partition("/")
        root = Path(str(resources.files(package)))
        for path in sorted(root.glob(inside)):
            found.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return found.hexdigest()[:12]


def _workers(text: str) -> int | str:
    return text if "://" in text else int(text)


JOBS = "jobs at a time, one thread each, or the address of a running Dask scheduler"
WORKERS = given("--workers", "N|ADDRESS", JOBS, _workers, default=2)


def layout_option(own: str) -> Argument:
    """The option `--layout`, which makes rows for each layout that it names."""
    about = f"make rows for it, as skin.layout; may be repeated; '{OWN}': {own} (the default)"
    return given("--layout", "LAYOUT", about, action="append")


def layouts(named: Sequence[str] | None) -> list[str]:
    """The layouts that `--layout` named, "" for OWN.

    Raises:
        SetupError: rows of two could not be told apart.
    """
    found: dict[str, str] = {}
    for spec in named or [OWN]:
        kept = "" if spec == OWN else spec if ":" in spec else str(Path(spec).resolve())
        if found.setdefault(layout_name(kept), kept) != kept:
            raise SetupError(f"--layout: two are called {layout_name(kept)}; rename a file")
    return list(found.values())


def layout_name(layout: str) -> str:
    """A layout as tables name it: a file's name without its ending, or its line of numbers."""
    return layout if ":" in layout else Path(layout).stem


def run(
    jobs: Sequence[Job],
    memory: Path,
    *,
    workers: int | str = 2,
    describe: Callable[[Any], str] = lambda _: "",
    tell: Callable[[float], None] | None = None,
) -> dict[str, Any]:
    """Results by job name; those that `memory`, a directory, holds are not run again.

    `workers`: how many, of one thread each, or the address of a running Dask scheduler, whose
    workers the jobs run on. `describe` writes a result for the line on stderr that follows each
    job; or else `tell` is told the share of the jobs that is done. On an interrupt the results so
    far are kept and the interrupt goes on.

    Raises:
        SetupError: no such scheduler answers, `memory` cannot be written, or a worker died.
    """
    if isinstance(workers, int) and workers < 1:
        raise SetupError("--workers must be at least 1")
    with _writing(memory):
        memory.mkdir(parents=True, exist_ok=True)
    results = {job.name: read(job, memory) for job in jobs}
    todo = [job for job in jobs if results[job.name] is None]
    if todo and len(todo) < len(jobs):
        _say(f"{len(jobs) - len(todo)} of {len(jobs)} runs are remembered in {memory}")
    began_s = time.monotonic()
    for done, (job, result) in enumerate(_results(todo, workers), 1):
        results[job.name] = result
        _write(job, memory, result)
        if tell is not None:
            tell(done / len(todo))
            continue
        spent_s = time.monotonic() - began_s
        left_s = spent_s * (len(todo) - done) / done
        taken = f"{done} of {len(todo)}, {spent_s:.0f} s, {left_s:.0f} s left"
        _say(": ".join(filter(None, (taken, job.name, describe(result)))))
    return results


def _results(todo: Sequence[Job], workers: int | str) -> Iterator[tuple[Job, Any]]:
    """Each job with its result, as it comes."""
    count = 0 if isinstance(workers, str) else min(workers, len(todo))
    if not todo or count == 1:
        yield from ((job, _work(job)) for job in todo)
        return
    pools = _on_dask(workers) if isinstance(workers, str) else _processes(count)
    with pools as pool:
        futures = {pool.submit(_work, job): job for job in todo}
        yield from ((futures[future], future.result()) for future in as_completed(futures))


def read(job: Job, memory: Path) -> Any:
    """The remembered result of a job; None without one."""
    try:
        return json.loads((memory / f"{job.key}.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def save(path: Path, name: str, rows: Sequence[Any], about: Mapping[str, Any]) -> Path:
    """Write rows of results as JSON, a row a line: a diff can be read; before them what is said
    `about` them. Raises SetupError."""
    head = "".join(f"{json.dumps(key)}: {json.dumps(value)},\n" for key, value in about.items())
    lines = ",\n".join(map(json.dumps, rows))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f'{{{head}"{name}": [\n{lines}\n]}}\n', encoding="utf-8")
    except OSError as error:
        raise SetupError(f"--out: cannot write {path} ({error.strerror})") from None
    return path


def forget(job: Job, memory: Path) -> None:
    """Forget a job's result, as a file that it made beside it is missing."""
    (memory / f"{job.key}.json").unlink(missing_ok=True)


def _work(job: Job) -> Any:
    return job.work(*job.arguments, *job.beside)


def _write(job: Job, memory: Path, result: Any) -> None:
    part = memory / f"{job.key}.part"
    with _writing(memory):
        part.write_text(json.dumps(result), encoding="utf-8")
        part.replace(part.with_suffix(".json"))  # whole or not at all


@contextlib.contextmanager
def _writing(memory: Path) -> Iterator[None]:
    """Raise SetupError where the memory cannot be written."""
    try:
        yield
    except OSError as error:
        raise SetupError(
            f"--memory: {memory}: {error.strerror}; name a directory that can be written"
        ) from None


@contextlib.contextmanager
def _processes(workers: int) -> Iterator[Executor]:
    """Processes of one thread each that end when this one does, however it ends."""
    for name in ONE_THREAD:
        os.environ.setdefault(name, "1")  # inherited by the workers
    pool = ProcessPoolExecutor(workers, get_context("spawn"), _begin)
    try:
        yield pool
    except BrokenExecutor:
        raise SetupError(
            "a worker process died, perhaps for want of memory: try again with --workers 1; "
            "finished jobs are kept"
        ) from None
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def _begin() -> None:
    """Begin a worker. It would wait for work for ever if its parent were killed."""

    def end() -> None:
        parent = parent_process()
        if parent is not None:
            parent.join()
        os._exit(1)

    threading.Thread(target=end, daemon=True).start()


@contextlib.contextmanager
def _on_dask(address: str) -> Iterator[Executor]:
    """The workers of a cluster."""
    from distributed import Client  # noqa: PLC0415  (an extra)

    try:
        client = Client(address, timeout=PATIENCE)
    except (OSError, ValueError) as error:
        raise SetupError(f"--workers: no scheduler answers at {address} ({error})") from None
    with client:
        pool = client.get_executor(pure=False)
        try:
            yield pool
        finally:
            pool.shutdown(wait=False)  # what was not begun is not run


def _say(line: str) -> None:
    sys.stderr.write(f"{line}\n")
