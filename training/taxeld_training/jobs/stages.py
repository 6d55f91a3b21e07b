"""How far a long command is: its stages from the start, as bars on a terminal or as lines."""

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

Tell = Callable[[str, float], None]  # stage, share of it that is done


@contextmanager
def shown(stages: Sequence[str], stream: TextIO) -> Iterator[Tell]:
    """→ what to call with a stage of `stages`, which follow one another, and its share."""
    if stream.isatty():
        with _bars(stages, stream) as tell:
            yield tell
    else:
        yield _lines(stages, stream)


def _lines(stages: Sequence[str], stream: TextIO) -> Tell:
    """A line a stage, once it is done, with what it took."""
    began_s = time.monotonic()
    left = list(stages)

    def tell(stage: str, share: float) -> None:
        nonlocal began_s
        if share < 1.0 or stage not in left:
            return
        left.remove(stage)
        now_s = time.monotonic()
        number = len(stages) - len(left)
        print(f"{number}/{len(stages)} {stage}: {now_s - began_s:.0f} s", file=stream, flush=True)
        began_s = now_s

    return tell


@contextmanager
def _bars(stages: Sequence[str], stream: TextIO) -> Iterator[Tell]:
    columns = (
        TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn(),
        TextColumn("left"), TimeRemainingColumn(),
    )  # fmt: skip
    with Progress(*columns, console=Console(file=stream)) as bars:
        tasks = {
            stage: bars.add_task(f"{number}/{len(stages)} {stage}", total=1.0, start=False)
            for number, stage in enumerate(stages, 1)
        }
        begun: set[str] = set()

        def begin(stage: str) -> None:
            if stage not in begun:
                begun.add(stage)
                bars.start_task(tasks[stage])

        def tell(stage: str, share: float) -> None:
            begin(stage)
            bars.update(tasks[stage], completed=share)
            following = stages.index(stage) + 1
            if share >= 1.0 and following < len(stages):
                begin(stages[following])

        begin(stages[0])
        yield tell
