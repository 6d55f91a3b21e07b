"""`taxeld advise`: which of some approaches would tell most, by what a running daemon remembers.

A client: the daemon hands over what it has felt, and this process learns it by the same estimator.
"""

import io
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import astuple, fields
from pathlib import Path

import numpy as np

from taxeld import files
from taxeld.advice.advice import Advised, TouchMemory
from taxeld.advice.candidates import Candidate
from taxeld.commands import running
from taxeld.config.tables import Config
from taxeld.errors import SetupError
from taxeld.estimator.scans import scans_of
from taxeld.service.prepare import prepared

LARGEST = 1_000_000  # bytes of a file
OTHER = "the daemon has another scene, skin or filter than this configuration: name the one it runs"


def read(path: Path, names: Sequence[str]) -> list[Candidate]:
    """The candidates of a CSV file; `names` are of the links: of several, it has a column `link`.

    Raises:
        SetupError: it cannot be read, or a line is none.
    """
    columns = [each.name for each in fields(Candidate)][: len(fields(Candidate)) - (len(names) < 2)]
    shape = ",".join(columns) + f" (link: {', '.join(names)})" * (len(names) > 1)
    try:
        head, *rows = files.read(path, LARGEST).decode("utf-8-sig").replace(" ", "").splitlines()
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or "no lines of UTF-8 text"
        raise SetupError(f"{path}: unreadable ({why}); name a CSV file of {shape}") from None
    if head.split(",") != columns or not rows:
        raise SetupError(f"{path}: must be the line {shape} and one for each approach")
    found = []
    for number, row in enumerate(rows, 2):
        try:
            values = dict(zip(columns, row.split(","), strict=True))
            link = names.index(values.pop("link", names[0]))
            numbers = {name: float(value) for name, value in values.items()}
            found.append(Candidate(**numbers, link=link))
        except SetupError as error:
            raise SetupError(f"{path}:{number}: {error}") from None
        except ValueError:
            raise SetupError(f"{path}:{number}: must be {shape}, not {row!r:.60}") from None
    return found


def remembered(config: Config) -> TouchMemory:
    """What the daemon of a configuration has felt so far.

    Raises:
        SetupError: a file that the configuration names cannot be used, or the daemon has another
            configuration.
        WorkError: it does not answer, or has felt nothing yet.
    """
    if not config.scene.names:
        raise SetupError("scene.bundle: is empty; advice is on an object")
    packed = running.answer(config.control.endpoint, "memory")["memory"]
    with np.load(io.BytesIO(packed), allow_pickle=False) as arrays:
        memory = dict(arrays)
    pipeline = prepared(config, time.time()).pipeline
    if memory["digest"].item() != pipeline.estimator.digest:
        raise SetupError(OTHER)
    pipeline.estimator.learn(scans_of(memory))
    calibrations = [stage.calibration for stage in pipeline.stages]
    return TouchMemory(
        pipeline.estimator, [None if one is None else one.mount for one in calibrations]
    )


def lines(found: Iterable[Advised], names: Sequence[str]) -> Iterator[str]:
    """Lines for a person; `names` are of the links."""
    yield "nats  touches  free       x       y  theta      x1      y1"
    for one in found:
        *place, link = astuple(one.candidate)
        x, y, theta, x1, y1 = place
        says = f"{one.nats:4.2f}  {one.p_touch:7.0%}  {one.free_m:4.2f}"
        way = f"{x:6.3f}  {y:6.3f}  {theta:5.2f}  {x1:6.3f}  {y1:6.3f}"
        yield f"{says}  {way}  {names[link]}".rstrip()
