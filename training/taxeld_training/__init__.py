"""Offline: meshes to scenes, contacts to samplers, samplers to ONNX. The only user of torch."""

import os

os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # before onnxruntime is imported anywhere
