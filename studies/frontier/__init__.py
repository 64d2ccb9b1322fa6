"""Error at equal activity: ``python -m studies.frontier``."""
