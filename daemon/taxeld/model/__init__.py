"""What a touch is, as mathematics: poses, scenes, contacts, the observation model, symmetry.

Pure: no clock, file, socket or thread, here or in anything it imports.
"""
