"""Work that may be put down between its parts and gone on with later: generators that yield where
they may pause, and return the result. What comes of it does not depend on the pauses."""

from collections.abc import Generator
from typing import TypeVar

T = TypeVar("T")
Parts = Generator[None, None, T]


def done(parts: Parts[T]) -> T:
    """All parts at once."""
    while True:
        try:
            next(parts)
        except StopIteration as end:
            result: T = end.value
            return result
