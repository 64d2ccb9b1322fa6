"""Analytic policy gradients: a policy with a memory follows the exact gradient of the cost through the plant."""

from .algorithm import APG
from .policy import RecurrentPolicy

__all__ = ["APG", "RecurrentPolicy"]
