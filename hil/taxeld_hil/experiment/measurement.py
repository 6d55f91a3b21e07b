"""Measurements of many runs: their rows, the digest of their code, and their files."""

import hashlib
import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

from taxeld.errors import SetupError
from taxeld.layout import read as layout_files
from taxeld.proposals import bundle, manifest
from taxeld_hil.grade.grade import Grade
from taxeld_hil.integrity import is_found
from taxeld_hil.jobs import layout_name
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.trials.case import code

RunRow: TypeAlias = dict[str, Any]  # one run's figures, as JSON has them


def title(name: str, subject: Scenario, seed: int) -> str:
    """A run as the progress of jobs names it."""
    bundle, skin, layout, _ = about(subject, seed).values()
    return ", ".join(filter(None, [name, bundle, skin, layout, f"seed {seed}"]))


def about(subject: Scenario, seed: int) -> RunRow:
    """What a run is of."""
    return {
        "bundle": subject.bundle,
        "skin": subject.physics,
        "layout": layout_name(subject.layout),  # empty: what the bundle was built for
        "seed": seed,
    }


def row(grade: Grade) -> RunRow:
    """The figures of a run that was graded."""
    figures, error_mm = grade.figures, grade.figures["error_mm"]
    return {
        "passed": grade.passed,  # all checks
        "found": error_mm is not None and bool(is_found(error_mm)),
        "error_mm": None if error_mm is None else round(error_mm, 3),  # up to symmetry
        "status": figures["status"],
        "contacts": figures["contacts"],  # counted by the daemon
        "misleading_at_s": figures["misleading"]["at_s"],  # begins of episodes
        "faults": figures["faults"],
        "failed": grade.failed,
    }


def digest(subject: Scenario) -> str:
    """Hash of all that a run of a scenario depends on but its seed: code, scenario, bundle, and
    the content of a layout file.

    Raises:
        SetupError: the bundle or the file cannot be found or read.
    """
    info = manifest.read(bundle.find(subject.bundle) / manifest.NAME)  # has digests of its files
    text = f"{code()}\0{subject!r}\0{content(subject.layout)}"
    return hashlib.sha256(text.encode() + info).hexdigest()[:16]


def save(path: Path, runs: Sequence[RunRow], **about: Any) -> None:
    """Write runs as JSON, a run a line: a diff can be read; before them what is said `about` them,
    a value a line.

    Raises:
        SetupError: the file cannot be written.
    """
    lines = ",\n".join(map(json.dumps, runs))
    head = "".join(f"{json.dumps(key)}: {json.dumps(value)},\n" for key, value in about.items())
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f'{{{head}"runs": [\n{lines}\n]}}\n', encoding="utf-8")
    except OSError as error:
        raise SetupError(f"--out: {path}: cannot be written ({error.strerror})") from None


@cache
def content(layout: str) -> str:
    """The digest of a layout file, or of a line; empty: of the bundle's own."""
    return layout_files.read(layout).digest if layout else ""
