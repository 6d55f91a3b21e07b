"""The belief about one object: how scans change it, and how reliable it is.

Pure: on one machine and build the same scans and seed give the same bytes. It chooses no proposal.
"""
