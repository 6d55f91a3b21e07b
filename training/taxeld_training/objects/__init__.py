"""Objects on skins: how the two stand to each other, and doubts about how a mesh lies and is cut.

A setting names an object and a skin. Nothing here imports another room of training.
"""

from taxeld.config.tables import SkinConfig

DEPTH_MAX_M = SkinConfig().full_scale_depth_m
