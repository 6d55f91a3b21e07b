"""Offline: meshes to scenes, contacts to samplers, samplers to ONNX. The only user of torch."""
