"""The commands that tuned what ships, on training and validation seeds."""
