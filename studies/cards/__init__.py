"""Model cards of the shipped agents: ``python -m studies.cards``."""
