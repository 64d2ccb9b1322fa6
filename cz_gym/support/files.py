"""Files that are written whole or not at all, folders that one process uses, and errors that name the path.

One file is replaced by one rename, which no kill or full disk can leave half done. Several files are replaced one
after the other: who needs to know that all of them are there writes the one that says so last.
"""

import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from .errors import CzError

LOCK = ".lock"
"""Name of the lock file of a folder that a process uses."""


@contextmanager
def name_file_in_errors(path: str | Path) -> Iterator[None]:
    """Context in which a file or folder that the user named is read or written.

    An OSError inside, and text that is not UTF-8, become a CzError that says which path and why.
    """
    try:
        yield
    except OSError as error:
        raise CzError(f"{path}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise CzError(f"{path}: not a text file in UTF-8") from error


def write_files(files: Mapping[Path, bytes]) -> None:
    """Write files in this order, each whole or not at all; folders are made if need be.

    Raises CzError naming the file that could not be written. All contents are on the disk before the first file is
    replaced, so that a full disk changes nothing. A killed writer may leave a hidden file ``.NAME.*.new``.
    """
    staged: dict[Path, Path] = {}
    try:
        for path, content in files.items():
            if path.is_dir():
                raise CzError(f"{path} is a folder")
            staged[path] = path.with_name(f".{path.name}.{os.getpid()}.new")
            with name_file_in_errors(path):
                path.parent.mkdir(parents=True, exist_ok=True)
                with open(staged[path], "wb") as file:
                    file.write(content)
                    file.flush()
                    os.fsync(file.fileno())
        for path, new in staged.items():
            with name_file_in_errors(path):
                os.replace(new, path)
    finally:
        for new in staged.values():
            if new.exists():
                new.unlink()


@contextmanager
def locked(folder: Path, patience: float = 0.0) -> Iterator[None]:
    """Context in which this process alone uses a folder, made if need be, and removed if it stays empty.

    Raises CzError if another process uses it for longer than ``patience`` [s].
    """
    from filelock import FileLock, Timeout

    lock = FileLock(folder / LOCK, timeout=patience)
    new = [each for each in (folder, *folder.parents) if not each.exists()]
    with name_file_in_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        try:
            lock.acquire()
        except Timeout:
            raise CzError(f"{folder}: another process is at work in this folder") from None
    try:
        yield
    finally:
        if os.name == "posix":  # whoever waits for the lock sees that its file is gone, and makes a new one
            (folder / LOCK).unlink(missing_ok=True)
        lock.release()
        with suppress(OSError):  # not empty
            for each in new:
                each.rmdir()


def check_writable(path: Path) -> None:
    """Raise CzError unless files could be written into the folder ``path``, made if need be; leaves no trace."""
    existing = path
    while not existing.exists():
        existing = existing.parent
    if not existing.is_dir():
        raise CzError(f"{path}: {existing} is not a folder")
    with name_file_in_errors(path), tempfile.TemporaryFile(dir=existing):
        pass
