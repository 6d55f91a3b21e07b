"""Layout files: CySkin's own robotskinlib JSON (version 2), and a plain table (`.csv`).

A reader returns the taxels of the file, in metres and in the file's frame, and counts what it left
out. Any other content raises one ValueError that names the place.
"""

import json
import re
import reprlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taxeld import files
from taxeld.arrays import Floats
from taxeld.layout import normals
from taxeld.layout.generated import TAXELS_PER_MODULE
from taxeld.layout.layout import Provenance
from taxeld_protocol.modules import NAMES

MAX_TAXELS = 5000  # a link's skin has hundreds
MISSING_ID = -1
UID_BITS = 36  # SUI u32 << 4 | name
COLUMNS = ["x", "y", "z", "nx", "ny", "nz"]  # of a plain table
NUMBER_MAX = 1e6
METRES_MAX = 5.0  # m: a wider patch is in mm, as no link is 5 m wide and no module under 5 mm
RIGID_TOLERANCE = 0.01  # files write 0.7071 for √½
NORMAL_MIN = 1e-3


@dataclass(frozen=True, slots=True)
class Patch:
    """M taxels in the file's frame."""

    uid: NDArray[np.int64]  # (M,) all different
    position_m: Floats  # (M, 3)
    normal: Floats  # (M, 3) unit; may point inwards
    source: Provenance


def read(path: Path) -> Patch:
    """Read a layout file whose ending is one of READERS.

    Raises:
        ValueError: it cannot be read or is no such file: one line with file, place and cure.
    """
    try:
        if not path.exists():
            raise ValueError(f"{path}: no such file; correct the path")
        text = files.read(path).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError(f"{path}: is not UTF-8 text; name a layout file") from None
    except OSError as error:
        raise ValueError(
            f"{path}: unreadable ({error.strerror}); name a layout file that this user may read"
        ) from None
    try:
        return READERS[path.suffix.lower()](text)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


@dataclass(slots=True)
class _Gathered:
    """Taxels in the order of the file, in its unit."""

    uid: list[int] = field(default_factory=list)
    position: list[list[float]] = field(default_factory=list)
    normal: list[list[float]] = field(default_factory=list)
    source: Provenance = field(default_factory=Provenance)

    def add(self, uid: int, position: list[float], normal: list[float], place: str) -> None:
        """Add a taxel. Raises ValueError where the file has normals, and this one is zero."""
        if self.source.own_normals and np.linalg.norm(normal) < NORMAL_MIN:
            raise ValueError(f"{place}: the normal must not be zero; {_CURE}")
        self.uid.append(uid)
        self.position.append(position)
        self.normal.append(normal)

    def patch(self) -> Patch:
        source = self.source
        if not 0 < len(self.uid) <= MAX_TAXELS:
            raise ValueError(
                f"holds {len(self.uid)} usable taxels ({source.missing} missing, {source.cut} cut, "
                f"{source.duplicates} duplicate); 1..{MAX_TAXELS} are needed"
            )
        position, normal = np.array(self.position), np.array(self.normal)
        extent = float(np.ptp(position, axis=0).max())
        source.unit, metres = ("mm", 1e-3) if extent > METRES_MAX else ("m", 1.0)
        if extent * metres > METRES_MAX:
            raise ValueError(
                f"taxels span {extent:g}, too far for metres or millimetres; correct the positions"
            )
        if source.parent is not None:
            source.parent[:3, 3] *= metres
        position = position * metres
        if not source.own_normals:
            normal = normals.of_positions(position)
        unit = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        return Patch(np.array(self.uid, dtype=np.int64), position, unit, source)


_CURE = "correct it, or mark the taxel as missing"


def _robotskinlib(text: str) -> Patch:
    try:
        data = json.loads(text)
    except RecursionError:
        raise ValueError("is nested too deeply for a layout; export it again") from None
    except ValueError as error:
        raise ValueError(f"is not JSON ({error}); export it again") from None
    info, skin = _table(data, "info"), _table(data, "skin")
    version = info.get("file_version")
    if version not in (2, "2"):
        raise ValueError(
            f"info.file_version: must be 2, not {_show(version)}; export it as version 2"
        )
    gathered, seen = _Gathered(), set()
    for place, taxel in _taxels(skin.get("taxels"), "skin.taxels"):
        uid, cut = taxel.get("id"), taxel.get("cut", 0)
        if type(uid) is not int or not MISSING_ID <= uid < 1 << UID_BITS:
            raise ValueError(f"{place}.id: must be a UID, or -1 for missing, not {_show(uid)}")
        if not isinstance(cut, int):
            raise ValueError(f"{place}.cut: must be 0, or 1 for a cut taxel, not {_show(cut)}")
        if uid == MISSING_ID or not uid & 0xF or taxel.get("type", "pressure") != "pressure":
            gathered.source.missing += 1
        elif cut:
            gathered.source.cut += 1
        elif uid in seen:
            gathered.source.duplicates += 1
        elif uid & 0xF >= NAMES:
            raise ValueError(
                f"{place}.id: {uid} is taxel {uid & 0xF} of its module, "
                f"which has 1..{NAMES - 1}; {_CURE}"
            )
        else:
            seen.add(uid)
            position = _numbers(taxel.get("x"), 3, f"{place}.x")
            normal = _numbers(taxel.get("n"), 3, f"{place}.n")
            gathered.add(uid, position, normal, f"{place}.n")
    gathered.source.parent = _parent(skin.get("parent_frames"))
    return gathered.patch()


def _taxels(value: Any, place: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Each taxel with its place; some files group taxels in further lists."""
    if not isinstance(value, list):
        raise ValueError(f"{place}: must be a list of taxels, not {_show(value)}; export it again")
    for i, item in enumerate(value):
        here = f"{place}[{i}]"
        group = item if isinstance(item, list) else [item]
        for j, taxel in enumerate(group):
            where = f"{here}[{j}]" if group is item else here
            if not isinstance(taxel, dict):
                raise ValueError(f"{where}: must be a taxel {{…}}, not {_show(taxel)}; {_CURE}")
            yield where, taxel


def _parent(frames: Any) -> Floats | None:
    """The first parent frame's pose, which the file stores column by column."""
    if not (isinstance(frames, list) and frames and isinstance(frames[0], dict)):
        return None
    if "tf_matrix" not in frames[0]:
        return None
    place = "skin.parent_frames[0].tf_matrix"
    matrix = np.reshape(_numbers(frames[0]["tf_matrix"], 16, place), (4, 4), order="F")
    turn = matrix[:3, :3]
    rigid = np.allclose(turn @ turn.T, np.eye(3), atol=RIGID_TOLERANCE)
    if not (rigid and np.linalg.det(turn) > 0.0 and np.allclose(matrix[3], [0, 0, 0, 1])):
        raise ValueError(
            f"{place}: must be a rigid transform, column by column; transpose or remove it"
        )
    return matrix


def _csv(text: str) -> Patch:
    """Read a row a taxel under the header `uid,x,y,z,nx,ny,nz`, where the normals may lack, and the
    UIDs, which may stand last: without them they go up as those of a generated cylinder."""
    head, *rows = [line.replace(" ", "").split(",") for line in text.splitlines() or [""]]
    numbers = [column for column in head if column != "uid"]
    if numbers not in (COLUMNS, COLUMNS[:3]) or head not in (
        *(numbers, ["uid", *numbers], [*numbers, "uid"]),
    ):
        raise ValueError(f"line 1: must be uid,{','.join(COLUMNS)}; uid or the n… may lack")
    gathered, seen = _Gathered(), set[int]()
    gathered.source.own_normals = numbers == COLUMNS
    for number, words in enumerate(rows, 2):
        place, i = f"line {number}", len(seen)
        uid = (i // TAXELS_PER_MODULE + 1) << 4 | (i % TAXELS_PER_MODULE + 1)
        if "uid" in head:
            named = words.pop(0 if head[0] == "uid" else -1)
            uid = int(named) if re.fullmatch("[0-9]{1,11}", named) else -1
            if not 0 <= uid < 1 << UID_BITS or uid in seen:
                raise ValueError(f"{place}: {_show(named)} is no UID, or one for the second time")
        seen.add(uid)
        row = _row(words, place, len(numbers))
        gathered.add(uid, row[:3], row[3:] or [0.0] * 3, place)
    return gathered.patch()


def _row(words: list[str], place: str, count: int) -> list[float]:
    try:
        values: Any = [float(word) for word in words]
    except ValueError:
        values = words
    return _numbers(values, count, place)


def _table(value: Any, key: str) -> dict[str, Any]:
    inner = value.get(key) if isinstance(value, dict) else None
    if not isinstance(inner, dict):
        raise ValueError(f"{key}: must be an object, not {_show(inner)}; name a robotskinlib file")
    return inner


def _numbers(value: Any, count: int, place: str) -> list[float]:
    if isinstance(value, list) and len(value) == count and all(_is_number(v) for v in value):
        return [float(v) for v in value]
    raise ValueError(f"{place}: must be {count} numbers, not {_show(value)}; {_CURE}")


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) <= NUMBER_MAX


def _show(value: Any) -> str:
    return reprlib.repr(value)


READERS: dict[str, Callable[[str], Patch]] = {".json": _robotskinlib, ".csv": _csv}
