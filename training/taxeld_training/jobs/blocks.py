"""Trials of an experiment in blocks of seeds, each block a job.

A later run with more trials adds to those of a run with fewer, and one that is cut short has as
many of each subject as of any other.
"""

from collections.abc import Callable, Mapping
from typing import Any, Protocol, TypeVar

from taxeld_hil.jobs import Job
from taxeld_training.jobs.options import Options, run_jobs

SEEDS_APART = 100_000  # seeds between the first trials of two values of --seed


class Subject(Protocol):
    """What trials are of: hashable, with a `repr` that tells all that a result depends on."""

    @property
    def name(self) -> str:
        """Another one for each subject of a run."""


S = TypeVar("S", bound=Subject)


def seed_of(options: Options, first: int) -> int:
    """The seed of the trial with number `first`."""
    return SEEDS_APART * options.seed + first


def trials(
    wanted: Mapping[S, int],
    play: Callable[..., list[Any]],
    options: Options,
    size: int | Callable[[S], int],
    *,
    files: Mapping[S, str] | None = None,
    is_late: Callable[[S], bool] = lambda _: False,
) -> dict[S, dict[int, Any]]:
    """Results of the trials of subjects by their seeds, as many as given, or as time allows; a
    subject without any is left out.

    `play(subject, seed, count)` has the results of so many seeds; `files`: paths of further
    arguments, on which they do not depend. `size`: seeds of a job. Every subject gets a first block
    before any gets a second one; those that are late come last.
    """
    todo: list[tuple[int, S, Job]] = []
    for subject, count in wanted.items():
        block = size(subject) if callable(size) else size
        for first in range(0, count, block):
            seeds = seed_of(options, first), min(block, count - first)
            beside = () if files is None else (files[subject],)
            job = Job(f"{subject.name}-{first}", play, (subject, *seeds), beside)
            todo.append((first, subject, job))
    todo.sort(key=lambda each: (is_late(each[1]), each[0]))
    done = run_jobs([job for _, _, job in todo], options)
    found: dict[S, dict[int, Any]] = {subject: {} for subject in wanted}
    for first, subject, job in sorted(todo, key=lambda each: each[0]):
        found[subject].update(enumerate(done[job.name] or [], seed_of(options, first)))
    return {subject: results for subject, results in found.items() if results}
