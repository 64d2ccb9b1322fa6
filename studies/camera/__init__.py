"""What the camera sees, measured: ``python -m studies.camera``."""
