"""Rollouts, metrics, statistics and reports: how policies are compared."""

from .plotting import plot

__all__ = ["plot"]
