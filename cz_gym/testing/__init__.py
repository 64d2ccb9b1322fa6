"""Checks for vector environments, this one's and others': :func:`check_vector_env`."""

from __future__ import annotations

from .checker import check_vector_env

__all__ = ["check_vector_env"]
