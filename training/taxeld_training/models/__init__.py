"""Inverse observation models: simulated touches, networks, training, and export to ONNX."""
