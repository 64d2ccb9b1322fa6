"""A search of a recipe's hyperparameters: ``python -m studies.search``."""
