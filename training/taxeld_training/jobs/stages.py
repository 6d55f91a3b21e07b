"""How far a long command is: bars on a terminal, else a line for each stage that is done."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TextIO

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

Tell = Callable[[str, float], None]  # of a stage, and the share of it that is done


@contextmanager
def shown(stages: Sequence[str], stream: TextIO) -> Iterator[Tell]:
    """→ a function to call with a stage of `stages`, which follow one another, and its share."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    names = [f"{number}/{len(stages)} {stage}" for number, stage in enumerate(stages, 1)]
    began_s = [time.monotonic()]  # when each stage began [s], of the stages so far
    with Progress(*columns, console=Console(file=stream), disable=not stream.isatty()) as bars:
        tasks = [bars.add_task(name, total=1.0, start=name is names[0]) for name in names]

        def advance(stage: str, share: float) -> None:
            at = stages.index(stage)
            bars.update(tasks[at], completed=share)
            if share < 1.0 or len(began_s) > at + 1:
                return
            began_s.append(time.monotonic())
            if at + 1 < len(tasks):
                bars.start_task(tasks[at + 1])
            if not stream.isatty():
                took_s = began_s[-1] - began_s[-2]
                print(f"{names[at]}: {took_s:.0f} s", file=stream, flush=True)

        yield advance
