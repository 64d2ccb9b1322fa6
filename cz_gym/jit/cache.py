"""Compiled code on disk: one file a function and signature, checked before it is used.

numba keeps an index beside numbered files. Two processes that compile at once, or one that is killed between the two
writes, can leave an index that names the code of another signature, which then runs on arguments it was not made for.
Here a file is named by the types that it was compiled for, repeats them inside, and is replaced whole; code that cannot
be loaded is compiled again. A file is trusted as those of ``__pycache__`` are.
"""

import hashlib
import os
import pickle
import sys
import tempfile
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import CodeType
from typing import Any

import llvmlite
import numba
import numpy as np
from numba.core import caching, serialize

from cz_gym.errors import CzError
from cz_gym.support.atomic_files import write_files

PACKAGE = Path(__file__).parents[1]
CACHE_VARIABLE = "CZ_GYM_CACHE_DIR"
"""Environment variable naming the folder for compiled code; empty means: keep none."""
NEVER_COMPILED = (
    "agents", "baselines", "commands", "datasets.py", "evaluation", "machine/export", "machine/pullers",
    "machine/serve", "rendering", "sb3.py", "support/command_line.py",
)  # fmt: skip
"""Parts of the package of which nothing is compiled in; all others count, whatever they hold."""
FunctionCache: Any = caching.FunctionCache
dumps: Any = serialize.dumps


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


def compiled_sources(folder: Path | None = None) -> list[Path]:
    """Every file of the package that compiled code may have taken a function or a constant from, sorted."""
    folder = folder or PACKAGE
    files = (file for kind in ("*.py", "*.json") for file in folder.rglob(kind))
    apart = [folder / part for part in NEVER_COMPILED]
    return sorted(file for file in files if not any(file.is_relative_to(part) for part in apart))


def source_hash(folder: Path | None = None) -> str:
    """Hash of the names and the code of :func:`compiled_sources` (32 hex digits)."""
    return hash_files(compiled_sources(folder))


@cache
def cache_folder() -> Path | None:
    """The writable folder for this version's compiled code, or None if there is none."""
    named = os.environ.get(CACHE_VARIABLE)
    if named == "":
        return None
    try:
        home = Path(named) if named else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "cz-gym"
        versions = f"numba{numba.__version__}-llvmlite{llvmlite.__version__}-numpy{np.__version__}"
        folder = home / f"{source_hash()}-{versions}"
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        if not named and hasattr(os, "getuid") and folder.stat().st_uid != os.getuid():
            return None
        with tempfile.TemporaryFile(dir=folder):
            pass
    except (OSError, RuntimeError):
        return None
    return folder


def hashed(*functions: Callable[..., Any]) -> bool:
    """Whether :func:`source_hash` sees the text of every one of these functions."""
    seen = {str(file) for file in compiled_sources()}
    codes = [getattr(function, "__code__", None) for function in functions]
    return all(code is not None and str(Path(code.co_filename)) in seen for code in codes)


class Store:
    """The files of one function's compiled code, in place of numba's index and files."""

    def __init__(self, folder: Path, name: str) -> None:
        self.folder, self.name = folder, name

    def path(self, key: Any) -> Path:
        """The file of the code for these types, this processor and these sources."""
        return self.folder / f"{self.name}.{hashlib.sha256(repr(key).encode()).hexdigest()[:32]}.code"

    def load(self, key: Any) -> Any:
        """The code saved for this key; None if there is none. A damaged file raises pickle's errors."""
        try:
            made_for, data = pickle.loads(self.path(key).read_bytes())
        except OSError:
            return None
        return data if made_for == key else None

    def save(self, key: Any, data: Any) -> None:
        """Save code if the disk has room; without room it is compiled again next time."""
        with suppress(CzError):
            write_files({self.path(key): dumps((key, data))})


class CachedCode(FunctionCache):  # type: ignore[misc]
    """numba's cache of one function, on a :class:`Store`."""

    def __init__(self, function: Any) -> None:
        super().__init__(function)
        files: Any = Store(Path(self._cache_path), self._impl.filename_base)
        self._cache_file = files

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Compiled code for this signature; None if there is none that can be loaded."""
        try:
            code = super().load_overload(sig, target_context)
        except Exception:
            code = None
        if code is None:
            announce()
        return code


@cache
def announce() -> None:
    """Print once, on a terminal, why the first use takes long."""
    if sys.stderr.isatty():
        print("cz_gym: compiling the plant for this machine, once; about 20 s", file=sys.stderr, flush=True)
