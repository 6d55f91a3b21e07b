"""The skin of most tests, and what its hub has of it."""

from taxeld.config.tables import SkinConfig
from taxeld.layout import read as layouts
from taxeld_protocol.modules import wired

SPEC = SkinConfig().layout
SKIN = layouts.load(SPEC)
MODULES = wired(SKIN.uid.tolist())
LISTED = tuple((module.sui or 0, module.mask) for module in MODULES)
CHANNELS = sum(module.channels for module in MODULES)
