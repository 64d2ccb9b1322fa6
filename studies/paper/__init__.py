"""Part II of the paper, redone on this plant: ``python -m studies.paper``."""
