"""How experiments run: options, rows and their tables, statistics. `taxeld_hil.jobs` runs the jobs.

Nothing here imports another room of training.
"""
