"""The mathematics of a touch: poses, scenes, contacts, the observation model, symmetry.

Pure: no clock, file, socket or thread, here or in anything it imports.
"""
