"""Checks for vector environments, this one's and others': :func:`cz_gym.testing.checker.check_vector_env`."""
