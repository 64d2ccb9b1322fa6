"""A hash of files that ignores formatting and comments."""

import hashlib
from collections.abc import Iterable
from pathlib import Path
from types import CodeType
from typing import Any


def hash_files(files: Iterable[Path]) -> str:
    """SHA-256 of the files' names, with their folder's, and contents (32 hex digits).

    Of a Python file its byte code counts: comments, docstrings and checks by ``assert`` change nothing.
    """
    digest = hashlib.sha256()
    for file in files:
        content = file.read_bytes()
        if file.suffix == ".py":
            content = repr(_byte_code(compile(content, "", "exec", dont_inherit=True, optimize=2))).encode()
        digest.update(f"{file.parent.name}/{file.name}".encode() + b"\0" + content + b"\0")
    return digest.hexdigest()[:32]


def _byte_code(value: Any) -> Any:
    """Code or one of its constants, without file and line numbers, as a value whose text is always the same."""
    if isinstance(value, frozenset):
        return sorted(map(repr, value))
    if not isinstance(value, CodeType):
        return value
    names = value.co_names, value.co_varnames, value.co_freevars, value.co_cellvars
    return value.co_code, value.co_flags, names, [_byte_code(each) for each in value.co_consts]
