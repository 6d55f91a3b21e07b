"""Objects: meshes, the scenes cut from them, and the bundles that hold them.

Training builds its bundles from these; nothing here knows of samplers, or of another room.
"""

HEIGHT_M = 0.04  # the sensor frame's origin above the object's lowest point
