"""Work in parts: generators that may pause where they yield, and return the result. The result does
not depend on the pauses."""

from collections.abc import Generator
from typing import TypeVar

T = TypeVar("T")
Parts = Generator[None, None, T]


def done(parts: Parts[T]) -> T:
    """Do all parts at once; → the result."""
    while True:
        try:
            next(parts)
        except StopIteration as end:
            result: T = end.value
            return result
