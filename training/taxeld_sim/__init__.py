"""The simulated world, trials in it, and what they answer. Nothing here needs torch."""
