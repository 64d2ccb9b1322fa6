"""Tuned controllers: a record each, the values that searches have chosen, and the search."""
