"""Counts to activations: baseline, noise, drift, temperature, foam, and unreliable taxels.

Pure: scans come in, activations and the state go out; the file of the state is kept elsewhere.
"""
