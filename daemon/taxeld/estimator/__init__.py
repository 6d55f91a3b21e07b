"""The belief about one object: what a scan tells, how particles learn from it, what that is worth.

Pure, and the same bytes for the same scans and seed. It is given a proposal and never chooses one.
"""
