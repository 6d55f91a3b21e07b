"""How experiments run: options, jobs side by side that can be resumed, rows, statistics, tables.

Nothing here imports another room of training.
"""
