"""The daemon's process: the fixed-rate loop, its clock, real time, systemd, kept state."""
