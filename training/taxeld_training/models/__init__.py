"""Inverse observation models: simulated touches, networks, training, and export to ONNX.

A model knows nothing of how it is measured: `limits` and the experiments import it, never the
other way round.
"""
