"""Packages that only some commands need, imported with an error that says what to install."""

from __future__ import annotations

import importlib
from typing import Any


def require(name: str, extra: str = "benchmark") -> Any:
    """The module of that name; ImportError in one line says which extra holds it."""
    try:
        return importlib.import_module(name)
    except ImportError:
        package = name.split(".")[0]
        raise ImportError(f"this needs the package {package}: pip install 'cz-gym[{extra}]'") from None
