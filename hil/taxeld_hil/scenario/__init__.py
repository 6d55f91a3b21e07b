"""A run's definition: the scenario's file, and the daemon's configuration that follows."""
