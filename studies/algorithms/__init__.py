"""Learning algorithms, and changes of a recipe, side by side: ``python -m studies.algorithms``."""
