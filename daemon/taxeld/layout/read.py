"""The layout that `skin.layout` names: generated, or read from a file."""

import math
from pathlib import Path

import numpy as np

from taxeld.errors import SetupError
from taxeld.layout import cylinder_fit, files, generated
from taxeld.layout.layout import Layout

NEAR_AXIS_M = 1e-9  # a taxel that is no farther from the axis has no outwards


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
            "as missing what lies elsewhere (taxeld layout --png draws it)"
        )
    return layout


def read(spec: str) -> Layout:
    """The layout named by `skin.layout`, on a cylinder or not.

    Raises:
        SetupError: the text is no layout, or the file cannot be used.
    """
    try:
        made = generated.parse(spec)
        if made is not None:
            return made
        if Path(spec).suffix.lower() not in files.READERS:
            raise ValueError(
                f"'{spec}' is no known layout; use '{generated.EXAMPLES['cylinder']}', "
                f"'{generated.EXAMPLES['wrap']}', a robotskinlib .json, or a .csv "
                "(examples/icub_positions.py makes one of an iCub's .txt)"
            )
        return _of_patch(Path(spec).stem, files.read(Path(spec)))
    except ValueError as error:
        raise SetupError(f"skin.layout: {error}") from None


def _of_patch(name: str, patch: files.Patch) -> Layout:
    """The patch in its sensor frame, under the file's name: names inside files repeat."""
    fit = cylinder_fit.fit(patch.position_m, patch.normal)
    turn, shift = fit.frame[:3, :3], fit.frame[:3, 3]
    position = patch.position_m @ turn.T + shift
    normal = np.where(fit.inwards[:, None], -patch.normal, patch.normal) @ turn.T
    if not patch.source.own_normals and math.isfinite(fit.radius_m):
        normal = position * (1.0, 1.0, 0.0)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), NEAR_AXIS_M)
    return Layout(
        name=name,
        uid=patch.uid,
        position_m=position,
        normal=normal,
        radius_m=fit.radius_m,
        frame=fit.frame,
        source=patch.source,
        turned=int(fit.inwards.sum()),
        no_cylinder=fit.why_none,
    )
