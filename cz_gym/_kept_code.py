"""Compiled code on disk: one file a function and signature, checked before it is used.

numba keeps an index beside numbered files. Two processes that compile at once, or one that is killed between the two
writes, can leave an index that names the code of another signature, which then runs on arguments it was not made for;
and a file cut short raises wherever it is read. Here a file is named by what it was compiled for, says so itself,
carries the hash of its contents and is replaced whole: any other is compiled again. It is code all the same, to be
trusted as ``__pycache__`` is.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any

from numba.core.caching import FunctionCache
from numba.core.serialize import dumps

DIGEST = hashlib.sha256().digest_size


class Store:
    """The files of one function; stands where numba's index and its files would."""

    def __init__(self, folder: Path, name: str) -> None:
        self.folder, self.name = folder, name

    def path(self, key: Any) -> Path:
        """Where the code for these types, this processor and this text is kept."""
        return self.folder / f"{self.name}.{hashlib.sha256(repr(key).encode()).hexdigest()[:32]}.code"

    def load(self, key: Any) -> Any:
        """What was saved for this key, or None; files that are damaged count as none."""
        try:
            content = self.path(key).read_bytes()
        except OSError:
            return None
        if hashlib.sha256(content[DIGEST:]).digest() != content[:DIGEST]:
            return None
        made_for, data = pickle.loads(content[DIGEST:])
        return data if made_for == key else None

    def save(self, key: Any, data: Any) -> None:
        """Keep it, if there is room: a full disk costs time, not the run."""
        content: bytes = dumps((key, data))  # type: ignore[no-untyped-call]
        temporary = None
        try:
            handle, temporary = tempfile.mkstemp(dir=self.folder, prefix=".code-")
            with os.fdopen(handle, "wb") as file:
                file.write(hashlib.sha256(content).digest() + content)
            os.replace(temporary, self.path(key))
        except OSError:
            if temporary is not None:
                with suppress(OSError):
                    os.unlink(temporary)


class KeptCode(FunctionCache):
    """numba's cache of one function, on a :class:`Store`."""

    def __init__(self, function: Any) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        files: Any = Store(Path(self._cache_path), self._impl.filename_base)
        self._cache_file = files

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Compiled code for this signature, or None: whatever cannot be put together again is compiled again."""
        try:
            return super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        except Exception:
            return None
