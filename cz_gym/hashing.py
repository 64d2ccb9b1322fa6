"""One hash of files: of their bytes, or of what Python files say but for comments, docstrings and layout."""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterable
from pathlib import Path


def hash_files(files: Iterable[Path], root: Path, code_only: bool = False) -> str:
    """SHA-256 of the files' names below ``root`` and of their contents (32 hex digits).

    With ``code_only`` a Python file counts as its syntax tree without docstrings: an edit of text changes nothing.
    """
    digest = hashlib.sha256()
    for file in files:
        content = file.read_bytes()
        if code_only and file.suffix == ".py":
            content = _code(content)
        digest.update(file.relative_to(root).as_posix().encode() + b"\0" + content + b"\0")
    return digest.hexdigest()[:32]


def _code(source: bytes) -> bytes:
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            node.body = [each for each in node.body if not _is_text(each)]
    return ast.dump(tree).encode()


def _is_text(statement: ast.stmt) -> bool:
    return isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)
