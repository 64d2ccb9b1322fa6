"""Searches of controller settings: ``python -m cz_gym.baselines.tuning --controller paper-tuned --scenario puller``."""
