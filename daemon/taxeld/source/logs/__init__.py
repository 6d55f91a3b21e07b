"""Recorded traffic as other tools write it, and a session's own files: told by content, read in
passes, never held in memory. What its frames mean is not known here.
"""
