"""Touches of the trials at the end of a build."""

TOUCHES = 8
