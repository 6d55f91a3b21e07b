"""The limits of samplers and filters: the exact posterior, and a filter on a grid.

The metrics stand here too. No sampler that ships is used to measure itself.
"""
