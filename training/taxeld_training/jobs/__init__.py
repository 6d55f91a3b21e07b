"""How experiments run: options, rows, statistics, tables. `taxeld_hil.jobs` runs their jobs.

Nothing here imports another room of training.
"""
