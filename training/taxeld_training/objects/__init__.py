"""Objects that models are trained for: doubts about a mesh, a scene's picture.

A setting names an object and a skin. Nothing here imports another room of training.
"""

from taxeld.config.tables import SkinConfig

DEPTH_MAX_M = SkinConfig().full_scale_depth_m
