"""The coverage-guided fuzzer's targets for files: `fuzz_files.py READER [flags of libFuzzer]`.

Any content is read or refused with one line (tests/readers.py). Findings become tests.
"""

import random
import sys
from pathlib import Path

import atheris

sys.path.insert(0, str(Path(__file__).parents[1]))
with atheris.instrument_imports(include=["taxeld", "taxeld_protocol", "taxeld_hil", "tomllib"]):
    from tests.readers import READERS, changed, used_or_refused

reader = READERS[sys.argv.pop(1)]


def one_input(content: bytes) -> None:
    used_or_refused(lambda: reader.use(content))


def mutated(content: bytes, most: int, seed: int) -> bytes:
    """Half of the time libFuzzer's own changes, else what breaks readers is put in as well."""
    rng = random.Random(seed)
    if rng.random() < 0.5:
        return bytes(atheris.Mutate(content, most))
    return changed(content, rng)[:most]


atheris.Setup(sys.argv, one_input, custom_mutator=mutated)
atheris.Fuzz()
