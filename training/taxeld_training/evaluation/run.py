"""How questions are answered: their trials as jobs, a row a touch, their figures and their files.

The jobs run side by side, here or on a cluster, and are remembered: a run that is cut short goes
on where it stopped, and one with more seeds adds to those that there are.
"""

import json
import sys
from collections.abc import Iterator, Sequence
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

import torch

from taxeld_sim import jobs
from taxeld_sim.answers import questions, score, tables
from taxeld_sim.answers.played import Played, played
from taxeld_sim.answers.questions import Cell, Question, Selection
from taxeld_sim.jobs import Job
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
            done = real.run(question, asked, workers.run)
        else:
            done = run(question, cells, asked, workers)
        rows = score.rows(done, question.by)
        rows += samplers.rows(question, workers.memory, workers.run)
        given = {"question": question.says, **_made(question.name)}
        data = jobs.save(out / f"{question.name}.json", "rows", rows, given)
        yield f"{question.name}: {question.says}"
        yield from (tables.text(rows, spec) + "\n" for spec in question.tables)
        yield str(data)
        yield str(_records(done, workers.memory / f"{question.name}.jsonl"))
        for name in question.charts:
            from taxeld_sim.answers import charts  # noqa: PLC0415  (matplotlib)

            charts.CHARTS[name](rows, out / f"{name}.png")
            yield str(out / f"{name}.png")


def run(
    question: Question, cells: Sequence[Cell], asked: Selection, workers: Workers
) -> list[Played]:
    """The trials of cells, with samplers that are trained for them."""
    each = (one for cell in cells for one in samplers.wanted(cell.case))
    files = samplers.files(each, question.effort, workers.memory, workers.run)
    of_cells = [[files.get(one, "") for one in samplers.wanted(cell.case)] for cell in cells]
    return played(cells, asked.seeds or range(question.seeds), workers.run, of_cells)


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
