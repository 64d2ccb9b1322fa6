"""Algorithms side by side at one budget: ``python -m studies.algorithms``."""
