"""How experiments run: their options, jobs side by side that can be resumed, rows and tables.

Nothing here imports another room of training.
"""
