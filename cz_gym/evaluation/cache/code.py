"""The code that results were made by, as one hash: kept results of other code are not used."""

from __future__ import annotations

import ast
import hashlib
import sys
from collections.abc import Iterable
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parents[2]
WITHOUT_RESULTS = ("agents", "baselines", "play", "rendering", "testing", "evaluation/cache", "evaluation/report")
"""Parts of the package that no figure comes from; controllers are counted by :func:`code_behind`."""


def code_behind(policy: object) -> str:
    """Hash of physics, draws, engine and metrics, and of the package, or lone module, that holds the policy's class.

    Comments, docstrings and line breaks do not count (16 hex digits).
    """
    parts = type(policy).__module__.split(".")
    if parts[0] != PACKAGE.name:
        return code_hash(str(sys.modules[type(policy).__module__].__file__))
    return code_hash(str(Path(str(sys.modules[".".join(parts[:2])].__file__)).parent))


@cache
def code_hash(controllers: str) -> str:
    """Hash of the package's own sources that figures come from, and of those in a folder or file."""
    return hash_sources([*own_sources(), *_sources(Path(controllers))])


def hash_sources(files: Iterable[Path]) -> str:
    """SHA-256 of what these Python files say but for comments, docstrings and line breaks (16 hex digits)."""
    digest = hashlib.sha256()
    for file in files:
        tree = ast.parse(file.read_bytes())
        for node in ast.walk(tree):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                node.body = [part for part in node.body if not _is_text(part)]
        digest.update(file.name.encode() + b"\0" + ast.dump(tree).encode() + b"\0")
    return digest.hexdigest()[:16]


def own_sources() -> list[Path]:
    """The package's own sources that figures come from."""
    names = {file: file.relative_to(PACKAGE).as_posix() for file in _sources(PACKAGE)}
    return [file for file, name in names.items() if not name.startswith(WITHOUT_RESULTS)]


def _sources(place: Path) -> list[Path]:
    return sorted(place.rglob("*.py")) if place.is_dir() else [place]


def _is_text(part: ast.stmt) -> bool:
    return isinstance(part, ast.Expr) and isinstance(part.value, ast.Constant) and isinstance(part.value.value, str)
