"""Measurements of many runs: `taxeld-hil expect` and `matrix`."""
