"""Pull a crystal by hand: ``python -m cz_gym.play``."""
