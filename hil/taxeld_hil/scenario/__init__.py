"""A run's definition: the scenario's TOML file, and the daemon's configuration that follows.

Nothing is simulated here.
"""
