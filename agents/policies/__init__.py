"""Agents that act: ONNX files, residuals on a controller, other control intervals."""
