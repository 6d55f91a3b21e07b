"""What a run is: the scenario's TOML file, and the daemon's configuration that follows from it.

Nothing is simulated here.
"""
