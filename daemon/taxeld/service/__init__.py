"""The daemon's process: the fixed-rate loop, its clock, latencies, real time, systemd, kept state.

It alone owns clocks, sockets and devices.
"""
