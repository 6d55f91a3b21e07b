"""Measurements of many runs: `taxeld-hil expect`, `matrix` and `soak`."""
