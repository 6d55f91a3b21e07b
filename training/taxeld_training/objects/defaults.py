"""How an object and a skin stand to each other where nothing else is asked for."""

from taxeld.config.tables import SkinConfig

HEIGHT_M = 0.04  # the sensor frame's origin above the object's lowest point
DEPTH_MAX_M = SkinConfig().full_scale_depth_m
