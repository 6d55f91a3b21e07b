"""Measurements of many runs: `taxeld-hil expect`, `matrix` and `soak`.

Their runs are jobs of `taxeld_hil.jobs`; figures are written as JSON and as a table.
"""
