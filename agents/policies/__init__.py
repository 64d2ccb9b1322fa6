"""Agents that act: ONNX files, and agents at other control intervals."""
