"""Runs of a measurement: played side by side, and remembered with a digest of their code.

So a measurement that was cut short goes on, and one of other code begins anew.
"""

import hashlib
import json
import os
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import cache
from importlib import resources
from multiprocessing import get_context
from pathlib import Path
from typing import IO, Any, Self, TypeVar

from taxeld.command_line import ONE_THREAD
from taxeld.errors import SetupError
from taxeld.proposals import bundle, manifest, seal
from taxeld_hil.scenario.scenario import Scenario

Job = TypeVar("Job")
Row = TypeVar("Row")


def digest(scenario: Scenario, *given: str) -> str:
    """Of all that a run depends on: the code, the scenario, its bundle, and what else is given.

    Raises:
        SetupError: the bundle cannot be found or read.
    """
    info = seal.read(bundle.find(scenario.bundle) / manifest.NAME)  # has digests of its files
    text = "\0".join((_code(), repr(scenario), *given))
    return hashlib.sha256(text.encode() + info).hexdigest()[:16]


@cache
def _code() -> str:
    """Of the code and what is shipped with it, as it was when this process first asked."""
    found = hashlib.sha256()
    for package in ("taxeld", "taxeld_protocol", "taxeld_hil"):
        root = Path(str(resources.files(package)))
        for path in sorted(root.rglob("*")):
            if path.suffix in (".py", ".toml") and path.is_file():
                found.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return found.hexdigest()


class Memory:
    """A file of runs, a line each, to which runs are added."""

    def __init__(self, path: Path) -> None:
        """Raises SetupError where the file cannot be written."""
        self._path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file: IO[str] = path.open("a", encoding="utf-8")
        except OSError as error:
            raise SetupError(f"--memory: {path}: {error.strerror}") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def rows(self, codes: Collection[str]) -> list[dict[str, Any]]:
        """The runs of these digests, as they were added; a line that was cut short is none."""
        found = []
        for line in self._path.read_text(encoding="utf-8").splitlines():
            try:
                row = json.loads(line)
                if row.pop("code") in codes:
                    found.append(row)
            except (ValueError, KeyError, TypeError, AttributeError):
                continue  # it is run again
        return found

    def add(self, code: str, row: dict[str, Any]) -> None:
        self._file.write(json.dumps({"code": code, **row}) + "\n")
        self._file.flush()


def played(play: Callable[[Job], Row], todo: Sequence[Job], workers: int) -> Iterator[Row]:
    """`play` of each job, in any order; one thread a worker."""
    if workers <= 1 or len(todo) <= 1:
        yield from map(play, todo)
        return
    for name in ONE_THREAD:
        os.environ.setdefault(name, "1")  # inherited by the workers
    with ProcessPoolExecutor(min(workers, len(todo)), get_context("spawn")) as pool:
        try:
            jobs = [pool.submit(play, each) for each in todo]
            for job in as_completed(jobs):
                yield job.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
