"""`taxeld-train evaluate` for filters: simulated trials, and the estimates of a filter in them.

Imports all rooms but `samplers`, and `charts` only where it draws.
"""
