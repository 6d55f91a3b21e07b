"""The belief about one object: how scans change it, and how reliable it is.

Pure: the same scans and seed give the same bytes. The proposal is given to it, never chosen here.
"""
