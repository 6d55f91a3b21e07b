"""Places of the taxels: a skin's layout, generated or read from a file, in its sensor frame.

Nothing here knows of objects, counts or activations.
"""
