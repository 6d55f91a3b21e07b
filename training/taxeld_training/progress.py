"""How far a long command is: a line when a stage is done, and one at least each half minute."""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TextIO, TypeAlias

MUTE_S = 25.0  # longest time without a line

Tell: TypeAlias = Callable[[str, float], None]
"""Is told a stage, and the share of it that is done."""


@contextmanager
def shown(stages: Sequence[str], stream: TextIO) -> Iterator[Tell]:
    """→ A function that shows how far the `stages` are, which follow one another."""
    names = {stage: f"{n}/{len(stages)} {stage}" for n, stage in enumerate(stages, 1)}
    left, share, began_s = [*names], 0.0, time.monotonic()
    lock, ended = threading.Lock(), threading.Event()

    def write(text: str) -> None:
        line = f"{names[left[0]]}: {text}{time.monotonic() - began_s:.0f} s"
        print(line, file=stream, flush=True)

    def tell(stage: str, done: float) -> None:
        nonlocal share, began_s
        with lock:
            if stage not in left:
                return
            share = done
            if done >= 1.0:
                write("")
                left.remove(stage)
                share, began_s = 0.0, time.monotonic()

    def remind() -> None:
        while not ended.wait(MUTE_S):
            with lock:
                if left:
                    write(f"{share:.0%} after ")

    thread = threading.Thread(target=remind, daemon=True)
    thread.start()
    try:
        yield tell
    finally:
        ended.set()
        thread.join()
