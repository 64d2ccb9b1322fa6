"""Time of a benchmark's tasks against nodes of a Ray cluster: ``python -m studies.cluster``."""
