"""Whatever the files hold that the project reads: a value or one line, nothing else, no hang."""

import random

import pytest

from tests.rig.readers import READERS, TOKENS, changed, used_or_refused


@pytest.mark.parametrize("name", READERS)
def test_a_whole_file_is_read(name: str) -> None:
    """Else nothing that is asked below means anything."""
    for content in READERS[name].samples():
        READERS[name].use(content)


@pytest.mark.parametrize("name", READERS)
def test_a_changed_file_is_read_or_refused_with_one_line(name: str) -> None:
    reader, rng = READERS[name], random.Random(name)
    samples = reader.samples()
    for _ in range(reader.examples):
        content = changed(rng.choice(samples), rng)
        used_or_refused(lambda content=content: reader.use(content))  # type: ignore[misc]


@pytest.mark.parametrize("name", READERS)
def test_a_file_of_nothing_but_what_breaks_readers_is_read_or_refused(name: str) -> None:
    for content in (b"", *TOKENS, b"".join(TOKENS), bytes(range(256)) * 40):
        used_or_refused(lambda content=content: READERS[name].use(content))  # type: ignore[misc]
