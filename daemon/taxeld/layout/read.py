"""The layout that `skin.layout` names: generated, or read from a file, in its sensor frame.

Files are CySkin's own robotskinlib JSON (version 2), and plain tables (`.csv`). What is no taxel in
them is left out and counted; any other content is a fault that names its place.
"""

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from taxeld import files
from taxeld.arrays import Floats
from taxeld.config import gate
from taxeld.config.gate import between, key
from taxeld.errors import SetupError
from taxeld.layout import fit, generated
from taxeld.layout.generated import TAXELS_PER_MODULE
from taxeld.layout.layout import Layout, Provenance
from taxeld_protocol.modules import NAMES

MAX_TAXELS = 5000  # a link's skin has hundreds
MISSING_ID = -1
UID_MAX = (1 << 36) - 1  # SUI u32 << 4 | name
COLUMNS = ["x", "y", "z", "nx", "ny", "nz"]  # of a plain table
METRES_MAX = 5.0  # m: a wider patch is in mm, as no link is 5 m wide and no module under 5 mm
NORMAL_MIN = 1e-3
NEAR_AXIS_M = 1e-9  # a taxel that is no farther from the axis has no outwards
CURE = "correct it, or mark the taxel as missing"

Row = tuple[float, float, float]
Taxels = tuple[list[int], Floats, Floats]  # UIDs, positions (M, 3), normals (M, 3) or none (M, 0)


def load(spec: str) -> Layout:
    """The layout named by `skin.layout`, for a run.

    Raises:
        SetupError: it cannot be read, or its taxels lie on no cylinder.
    """
    layout = read(spec)
    if math.isinf(layout.radius_m):
        raise SetupError(
            f"skin.layout: {layout.name}: its {len(layout)} taxels lie on no cylinder "
            f"({layout.no_cylinder}); a run needs the skin of a round link: name its file, or mark "
            "as missing what lies elsewhere"
        )
    return layout


def read(spec: str) -> Layout:
    """The layout named by `skin.layout`, on a cylinder or not.

    Raises:
        SetupError: the text is no layout, or the file cannot be used.
    """
    try:
        made = generated.parse(spec)
    except ValueError as error:
        raise SetupError(f"skin.layout: {error}") from None
    if made is not None:
        return made
    path, source = Path(spec), Provenance()
    reader = READERS.get(path.suffix.lower())
    is_path = ":" not in spec and (path.suffix or len(path.parts) > 1)
    try:
        data = files.read(path) if reader or is_path else b""
        if reader is None:
            raise SetupError(
                f"skin.layout: '{spec}' is no known layout; use "
                f"'{generated.EXAMPLES['cylinder']}', '{generated.EXAMPLES['wrap']}', "
                "a robotskinlib .json, or a .csv "
                "(examples/icub_positions.py makes one of an iCub's .txt)"
            )
        text = data.decode("utf-8-sig")
        return _placed(path.stem, *reader(text, source), source)
    except OSError as error:
        fault = f"unreadable ({error.strerror}); name a layout file that this user may read"
    except UnicodeDecodeError:
        fault = "is not UTF-8 text; name a layout file"
    except ValueError as error:
        fault = str(error)
    raise SetupError(f"skin.layout: {path}: {fault}")


def _placed(
    name: str, uid: list[int], position: Floats, normal: Floats, source: Provenance
) -> Layout:
    """The taxels in their sensor frame, under the file's name: names inside files repeat.

    Raises:
        ValueError: there are none or too many, they lie too far apart, or a normal is zero.
    """
    if not 0 < len(uid) <= MAX_TAXELS:
        raise ValueError(
            f"holds {len(uid)} usable taxels ({source.missing} missing, {source.cut} cut, "
            f"{source.duplicates} duplicate); 1..{MAX_TAXELS} are needed"
        )
    extent = float(np.ptp(position, axis=0).max())
    source.unit, metres = ("mm", 1e-3) if extent > METRES_MAX else ("m", 1.0)
    if extent * metres > METRES_MAX:
        raise ValueError(
            f"taxels span {extent:g}, too far for metres or millimetres; correct the positions"
        )
    position = position * metres
    source.own_normals = normal.size > 0
    normal = normal if source.own_normals else fit.normals(position)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    if length.min() < NORMAL_MIN:
        raise ValueError(f"taxel {uid[length.argmin()]}: the normal must not be zero; {CURE}")
    normal = normal / length
    found = fit.cylinder(position, normal)
    turn, shift = found.frame[:3, :3], found.frame[:3, 3]
    position = position @ turn.T + shift
    normal = np.where(found.inwards[:, None], -normal, normal) @ turn.T
    if not source.own_normals and math.isfinite(found.radius_m):
        normal = position * (1.0, 1.0, 0.0)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), NEAR_AXIS_M)
    return Layout(
        name=name,
        uid=np.array(uid, dtype=np.int64),
        position_m=position,
        normal=normal,
        radius_m=found.radius_m,
        frame=found.frame,
        source=source,
        turned=int(found.inwards.sum()),
        no_cylinder=found.why_none,
    )


@dataclass(frozen=True, slots=True)
class Taxel:
    """A taxel of a robotskinlib file."""

    id: int = key(check=between(MISSING_ID, UID_MAX))  # UID, or -1 for missing
    cut: int = 0  # 1: it is cut off
    type: str = "pressure"
    x: Row | None = None  # position
    n: Row | None = None  # normal

    @property
    def is_missing(self) -> bool:
        return self.id == MISSING_ID or not self.id & 0xF or self.type != "pressure"


def _robotskinlib(text: str, source: Provenance) -> Taxels:
    try:
        data = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"is not JSON ({error}); export it again") from None
    info, skin = (data.get(k) if isinstance(data, dict) else None for k in ("info", "skin"))
    if not (isinstance(info, dict) and isinstance(skin, dict)):
        raise ValueError("info, skin: must be objects; name a robotskinlib file")
    if (version := info.get("file_version")) not in (2, "2"):
        raise ValueError(f"info.file_version: must be 2, not {version!r:.40}; export it again")
    taken: dict[int, Taxel] = {}
    for place, entry in _entries(skin.get("taxels")):
        faults: list[str] = []
        taxel = gate.value(Taxel, entry, faults, place, more=True)
        if faults:
            raise ValueError(f"{faults[0]}; {CURE}")
        if taxel.is_missing:
            source.missing += 1
        elif taxel.cut:
            source.cut += 1
        elif taxel.id in taken:
            source.duplicates += 1
        elif taxel.id & 0xF >= NAMES:
            name = f"{taxel.id} is taxel {taxel.id & 0xF} of its module, which has 1..{NAMES - 1}"
            raise ValueError(f"{place}.id: {name}; {CURE}")
        elif taxel.x is None or taxel.n is None:
            raise ValueError(f"{place}: needs x and n; {CURE}")
        else:
            taken[taxel.id] = taxel
    position, normal = (np.array([getattr(taxel, k) for taxel in taken.values()]) for k in "xn")
    return [*taken], position, normal


def _entries(taxels: Any) -> Iterator[tuple[str, Any]]:
    """Each taxel with its place; some files group taxels in further lists."""
    if not isinstance(taxels, list):
        raise ValueError("skin.taxels: must be a list of taxels; export it again")
    for i, item in enumerate(taxels):
        if not isinstance(item, list):
            yield f"skin.taxels[{i}]", item
            continue
        for j, taxel in enumerate(item):
            yield f"skin.taxels[{i}][{j}]", taxel


def _csv(text: str, source: Provenance) -> Taxels:  # noqa: ARG001
    """Read a row a taxel under a header of the columns, where the normals may lack, and the UIDs:
    without them they go up as those of a generated cylinder."""
    head, *lines = text.replace(" ", "").splitlines() or [""]
    columns = head.split(",")
    of_place = [column for column in columns if column != "uid"]
    if of_place not in (COLUMNS, COLUMNS[:3]) or len(columns) > len(of_place) + 1:
        raise ValueError(f"line 1: must be uid,{','.join(COLUMNS)}; uid or the n… may lack")
    rows: dict[int, list[float]] = {}
    for i, line in enumerate(lines):
        try:
            row = [float(word) for word in line.split(",")]
        except ValueError:
            row = []
        if len(row) != len(columns) or not all(map(math.isfinite, row)):
            raise ValueError(
                f"line {i + 2}: must be {len(columns)} numbers, not {line!r:.80}; {CURE}"
            )
        uid: float = (i // TAXELS_PER_MODULE + 1) << 4 | (i % TAXELS_PER_MODULE + 1)
        if "uid" in columns:
            uid = row.pop(columns.index("uid"))
        if uid != int(uid) or not 0 <= uid <= UID_MAX or uid in rows:
            raise ValueError(f"line {i + 2}: {uid:.15g} is no UID, or one for the second time")
        rows[int(uid)] = row
    table = np.reshape([*rows.values()], (-1, len(of_place)))
    return [*rows], table[:, :3], table[:, 3:]


READERS: dict[str, Callable[[str, Provenance], Taxels]] = {".json": _robotskinlib, ".csv": _csv}
