"""Agents where they were not trained: ``python -m studies.generalisation``."""
