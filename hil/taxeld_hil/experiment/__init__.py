"""Measurements of many runs: `taxeld-hil matrix`, `touches` and `calibration`.

Their runs are jobs of `taxeld_hil.jobs`; figures are written as JSON and as a table.
"""
