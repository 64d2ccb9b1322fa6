"""Rollouts, metrics, statistics and reports: how policies are compared."""
