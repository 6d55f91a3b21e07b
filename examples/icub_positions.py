"""Makes a table for `skin.layout` of an iCub's positions file, one of skinGui's `*.txt`.

    python icub_positions.py left_forearm_V2.txt > left_forearm_V2.csv

Row i is slot i mod 12 of triangle i div 12; triangles are counted through the part's boards, as by
iCub's own reader. A taxel's UID is `triangle << 4 | slot`.
"""

import re
import sys
from pathlib import Path

import numpy as np

from taxeld.layout import fit

SLOTS = 12  # of a triangle
PADS = (6, 10)  # slots of the common triangle that are thermal pads; a palm's are taxels
MIDDLE = 3  # slot of the common triangle's middle taxel
NEAR = 20  # taxels of a tangent plane: two triangles, over which a link is nearly flat


def table(text: str) -> str:
    """The table of a positions file. Raises ValueError where the text is none."""
    header, mark, body = text.partition("[calibration]")
    if not mark:
        raise ValueError("has no [calibration] rows; name an iCub skin positions file")
    words = [line.split() for line in body.splitlines() if line.strip()]
    rows = np.array(words, dtype=float).reshape(-1, 6)
    found = re.search(r"taxel2Repr\s*\(([^)]*)\)", header)
    middles = [int(word) for word in found[1].split()] if found else []
    kept = [i for i, row in enumerate(rows) if row.any() and _is_taxel(i, middles)]
    position, normal = rows[kept, :3], rows[kept, 3:]
    if not np.ptp(normal, axis=0).any():  # none is given, or one for all
        normal = fit.normals(position, NEAR)
    lines = ["uid,x,y,z,nx,ny,nz"]
    for i, numbers in zip(kept, np.hstack([position, normal]).tolist(), strict=True):
        lines.append(f"{i // SLOTS << 4 | i % SLOTS},{','.join(map(repr, numbers))}")
    return "\n".join(lines) + "\n"


def _is_taxel(row: int, middles: list[int]) -> bool:
    """Whether taxel2Repr has a taxel there. Some files list a common triangle's pads as well."""
    first = row - row % SLOTS
    is_common = {i for i in middles[first : first + SLOTS] if i >= 0} == {first + MIDDLE}
    return min(middles[row : row + 1], default=0) >= 0 and not (is_common and row % SLOTS in PADS)


if __name__ == "__main__":
    try:
        print(table(Path(sys.argv[1]).read_text(encoding="utf-8")), end="")
    except (OSError, ValueError) as error:
        sys.exit(f"{sys.argv[1]}: {error}")
