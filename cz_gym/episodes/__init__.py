"""Scenarios, and the draw of an episode from its random streams."""
