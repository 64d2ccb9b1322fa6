"""The plant beside the logs of a real puller: ``python -m studies.industrial``."""
