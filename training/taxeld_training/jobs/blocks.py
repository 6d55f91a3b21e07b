"""Seeds of the trials at the end of a build."""

SEEDS_APART = 100_000  # seeds between the first trials of two values of --seed
