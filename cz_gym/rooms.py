"""How the package's commands reach controllers and agents, which no other module of it knows."""

from __future__ import annotations

import importlib
from types import ModuleType


def room(name: str) -> ModuleType:
    """A module of ``baselines`` or ``agents``, by its name in the checkout: installed with the package, or beside it.

    Raises ImportError if it, or something it needs, is missing.
    """
    inside = f"cz_gym.{name}"
    try:
        return importlib.import_module(inside)
    except ModuleNotFoundError as error:
        if error.name is None or not (inside == error.name or inside.startswith(f"{error.name}.")):
            raise
    return importlib.import_module(name)
