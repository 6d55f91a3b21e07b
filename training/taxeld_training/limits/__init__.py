"""What no sampler or filter beats: the exact posterior, a filter on a grid, and metrics."""
