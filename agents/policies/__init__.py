"""Agents that act: ONNX files."""
