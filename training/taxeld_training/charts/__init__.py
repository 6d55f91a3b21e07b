"""Pictures from the rows of experiments; matplotlib is imported here alone.

Of training's rooms only `jobs` is imported, for the rows.
"""
