"""How questions are answered: their trials as jobs, a row a touch, their figures and their files.

The jobs run side by side, here or on a cluster, and are remembered: a run that is cut short goes
on where it stopped, and one with more seeds adds to those that there are.
"""

import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import date
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import torch

from taxeld_sim import jobs
from taxeld_sim.answers import questions, score, tables
from taxeld_sim.answers.questions import Cell, Question, Selection
from taxeld_sim.answers.score import Played
from taxeld_sim.jobs import Job
from taxeld_sim.trials.case import Case
from taxeld_sim.trials.play import play
from taxeld_training.evaluation import real, samplers

BLOCK = 10  # seeds a job


class Workers(NamedTuple):
    """Where jobs run, and where they are remembered."""

    workers: int | str  # of them, or the address of a Dask scheduler
    memory: Path

    def run(self, todo: Sequence[Job]) -> dict[str, Any]:
        """Results by job name; torch has one thread in each job."""
        torch.set_num_threads(1)  # here; workers have it from their environment
        return jobs.run(todo, self.memory, workers=self.workers)


def answer(names: Sequence[str], asked: Selection, workers: Workers, out: Path) -> Iterator[str]:
    """Lines: the table of each question, and the files that are written.

    Raises:
        SetupError: there is no such question, object or cell, or a skin misses an object.
    """
    todo = [questions.load(name, asked) for name in names]
    chosen = [questions.cells(each, asked) if each.cells else [] for each in todo]
    for question, cells in zip(todo, chosen, strict=True):
        if question.tilts:
            played = real.run(question, asked, workers.run)
        else:
            played = run(question, cells, asked, workers)
        rows = score.rows(played, question.by)
        rows += samplers.rows(question, workers.memory, workers.run)
        given = {"question": question.says, **_made(question.name)}
        data = jobs.save(out / f"{question.name}.json", "rows", rows, given)
        yield f"{question.name}: {question.says}"
        yield from (tables.text(rows, spec) + "\n" for spec in question.tables)
        yield str(data)
        yield str(_records(played, workers.memory / f"{question.name}.jsonl"))
        for name in question.charts:
            from taxeld_sim.answers import charts  # noqa: PLC0415  (matplotlib)
            from taxeld_training.evaluation import real_picture  # noqa: PLC0415

            draw: Any = real_picture.draw if question.tilts else charts.CHARTS[name]
            draw(asked.data if question.tilts else rows, out / f"{name}.png")
            yield str(out / f"{name}.png")


def run(
    question: Question, cells: Sequence[Cell], asked: Selection, workers: Workers
) -> list[Played]:
    """The trials of cells. Each has its first block of seeds before any has its second."""
    seeds = asked.seeds or tuple(range(question.seeds))
    each = (one for cell in cells for one in samplers.wanted(cell.case))
    files = samplers.files(each, question.effort, workers.memory, workers.run)
    todo = [list[Job]() for _ in cells]
    for cell, mine in zip(cells, todo, strict=True):
        case = cell.case
        beside = tuple(files.get(one, "") for one in samplers.wanted(case))
        for first in range(0, len(seeds), BLOCK):
            block = seeds[first : first + BLOCK]
            name = f"{cell.labels['object']} by {case.method.proposal} {case.digest}-{block[0]}"
            mine.append(Job(name, trials, (case, block), (beside,), case.digest))
    in_turn = [job for block in zip_longest(*todo) for job in block if job]
    done = workers.run(list({job.name: job for job in in_turn}.values()))
    return [
        Played.of(cell, seeds, [trial for job in mine for trial in done[job.name]])
        for cell, mine in zip(cells, todo, strict=True)
    ]


def trials(case: Case, seeds: Sequence[int], files: Sequence[str]) -> list[list[list[Any]]]:
    """A job: of each seed the fields of each touch; `files` have the samplers of known objects."""
    known = [replace(one, sampler=file) for one, file in zip(case.known, files, strict=True)]
    case = replace(case, known=tuple(known))
    return [[score.without_nan(list(touch)) for touch in play(case, seed)] for seed in seeds]


def _records(played: Sequence[Played], path: Path) -> Path:
    """A line for each touch of each trial."""
    part = path.with_suffix(".part")
    with part.open("w", encoding="utf-8") as file:
        for each in played:
            for row in each.records():
                file.write(json.dumps(row) + "\n")
    part.replace(path)
    return path


def _made(name: str) -> dict[str, str]:
    """The commit, the command and the date of a file."""
    command = " ".join(["taxeld-train", *sys.argv[1:]])
    return {
        "commit": commit(Path(__file__).parent),
        "command": command if name in command else f"taxeld-train evaluate {name}",
        "date": date.today().isoformat(),
    }


def commit(place: Path) -> str:
    """The commit of a folder's repository; `-dirty` if a file has changed since, outside of `docs`,
    where answers are written."""

    changed = tables.git(place, "status", "--porcelain", "-uno", "--", ":/", ":(top,exclude)docs")
    own = tables.git(place, "rev-parse", "--short=8", "HEAD")
    return (own or "unknown") + "-dirty" * bool(changed)
