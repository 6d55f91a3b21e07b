"""The skin of most tests, and what its hub has of it."""

from taxeld.config.tables import SkinConfig
from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld_protocol.modules import wired

SPEC = SkinConfig().layout
SKIN = layouts.load(SPEC)
MODULES = wired(SKIN.uid.tolist())
LISTED = tuple((module.sui or 0, module.mask) for module in MODULES)
CHANNELS = sum(module.channels for module in MODULES)


def table_of(layout: Layout, *, uid: bool = False) -> str:
    """A layout as a plain table, with the taxels' UIDs or without."""
    rows = zip(layout.position_m, layout.normal, layout.uid, strict=True)
    lines = [
        ",".join([*(f"{v:.6f}" for v in (*place, *normal)), *([str(own)] if uid else [])])
        for place, normal, own in rows
    ]
    return "\n".join([f"x,y,z,nx,ny,nz{',uid' * uid}", *lines, ""])
