"""How experiments run: options, statistics. `taxeld_hil.jobs` runs the jobs.

Nothing here imports another room of training.
"""
