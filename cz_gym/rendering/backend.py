"""pygame, loaded when the first picture is drawn, without output and with the user's environment unchanged."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import io
import warnings
from typing import Any

from gymnasium.error import DependencyNotInstalled

MISSING = 'rendering needs pygame: pip install ".[render]"'


def available() -> bool:
    """Whether pygame can be found."""
    return importlib.util.find_spec("pygame") is not None


def load() -> Any:
    """The pygame module; :class:`gymnasium.error.DependencyNotInstalled` says how to get it.

    pygame prints a greeting and its imports warn; both are suppressed.
    """
    try:
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return importlib.import_module("pygame")
    except ImportError:
        raise DependencyNotInstalled(MISSING) from None
