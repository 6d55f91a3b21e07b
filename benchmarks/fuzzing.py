"""Bounded runs of the coverage-guided fuzzer over every reader of the wire and of files.

Run by `make bench`. A finding is an exception, a hang, or more memory than a reader may take.
"""

import re
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))

from tests.readers import READERS

WIRE_RUNS = 200_000
FILES_S = 5  # a reader
LIMITS = ["-timeout=20", "-rss_limit_mb=1500", "-malloc_limit_mb=300"]


def rows() -> list[tuple[str, float, float | None]]:
    """(figure, measured, budget)."""
    wire = fuzzed(["fuzz.py", f"-runs={WIRE_RUNS}", "-max_len=600"])
    found, runs = 0, 0
    for name, reader in READERS.items():
        flags = [f"-max_total_time={FILES_S}", "-max_len=300000"]
        failed, done = fuzzed(["fuzz_files.py", name, *flags], reader.samples())
        found, runs = found + failed, runs + done
    return [
        (f"findings of the fuzzer on the wire in {wire[1]} runs", float(wire[0]), 0.0),
        (f"findings in {len(READERS)} readers of files in {runs} runs", float(found), 0.0),
    ]


def fuzzed(command: list[str], samples: list[bytes] = []) -> tuple[bool, int]:  # noqa: B006
    """Whether something was found, and in how many runs; the finding is printed."""
    with tempfile.TemporaryDirectory() as place:
        corpus = Path(place) / "corpus"
        corpus.mkdir()
        for k, sample in enumerate(samples):
            (corpus / str(k)).write_bytes(sample)
        done = subprocess.run(
            [sys.executable, str(HERE / command[0]), *command[1:], *LIMITS,
             f"-artifact_prefix={place}/", str(corpus)],
            capture_output=True, text=True, errors="replace", check=False,
        )  # fmt: skip
    runs = re.search(r"Done (\d+) runs", done.stderr)
    if done.returncode or runs is None:
        print(command[:2], done.stderr[-3000:])
    return bool(done.returncode or runs is None), int(runs[1]) if runs else 0
