"""`taxeld-train evaluate` for filters: simulated trials, and the estimates of a filter in them.

Imports all other rooms, `charts` only where it draws.
"""
