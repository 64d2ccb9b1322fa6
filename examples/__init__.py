"""Examples to copy: each file stands alone, and ``python -m cz_gym.examples.NAME`` runs it."""
