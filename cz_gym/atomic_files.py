"""Files that are replaced together or not at all, also when the writer is killed, and folders that one process uses.

:func:`write_files` first writes into a hidden folder beside the files' places, ``.writing``. Renaming that folder to
``.written`` is the one moment at which the new contents count; then each file moves to its place. If the writer is
killed before that moment, the next writer removes what is there; if it is killed after it, the next writer finishes
the moves. A lock file, which the system unlocks when its process ends, lets one process at a time write into a folder.
"""

from __future__ import annotations

import errno
import importlib
import os
import shutil
import tempfile
import time
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from cz_gym.errors import CzError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

BEGUN, COMPLETE = ".writing", ".written"
"""Hidden folders of new files, before and after the moment at which they count."""
WRITER, USER = ".writer.lock", ".user.lock"
"""Lock files: of the process that writes into a folder, and of the one that works in it."""
PATIENCE = 60.0
"""Longest wait for another process to finish writing [s]."""


def write_files(files: Mapping[Path, bytes]) -> None:
    """Write all files or none; those of one folder are replaced together. Raises OSError naming the file."""
    folders: dict[Path, dict[Path, bytes]] = {}
    for path, content in files.items():
        if path.is_dir():
            raise IsADirectoryError(f"{path} is a folder")
        folders.setdefault(path.parent.resolve(), {})[path] = content
    with ExitStack() as locks:
        for folder in sorted(folders):  # always in the same order, so that two writers cannot wait for each other
            folder.mkdir(parents=True, exist_ok=True)
            locks.enter_context(_writer(folder, folders[folder]))
            _write(folder / BEGUN, folders[folder])
        for folder in folders:
            with _naming(folder):
                os.rename(folder / BEGUN, folder / COMPLETE)
        for folder in folders:
            _place(folder)


def finish_writing(folder: Path) -> None:
    """Finish what a killed writer had completed in a folder, and remove what it had not. Raises OSError."""
    with _writer(folder, ()):
        pass


@contextmanager
def locked(folder: Path, patience: float = 0.0) -> Iterator[None]:
    """Reserve a folder, made if need be, for this process until it ends.

    ValueError if another process has it for longer than ``patience`` [s].
    """
    folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        try:
            stack.enter_context(_lock(folder / USER, patience))
        except TimeoutError:
            raise CzError(f"{folder}: another process is at work in this folder") from None
        yield


def check_writable(path: Path) -> None:
    """Raise OSError unless files could be written into the folder ``path``, made if need be; leaves no trace."""
    existing = path
    while not existing.exists():
        existing = existing.parent
    if not existing.is_dir():
        raise NotADirectoryError(f"{path}: {existing} is not a folder")
    try:
        with tempfile.TemporaryFile(dir=existing):
            pass
    except OSError as error:
        raise OSError(f"{path}: cannot be written ({error.strerror})") from None


@contextmanager
def _writer(folder: Path, paths: Collection[Path]) -> Iterator[None]:
    """Hold a folder while those files are written; what an earlier writer left is settled before."""
    with _lock(folder / WRITER, PATIENCE):
        _remove(folder / BEGUN)
        if _is_folder(folder / COMPLETE):
            _place(folder)
        try:
            yield
        except Exception:
            # Before the first file has moved, all of them can be given up; after that, the next writer goes on.
            if _is_folder(folder / COMPLETE) and len(list((folder / COMPLETE).iterdir())) == len(paths):
                _remove(folder / COMPLETE)
            raise
        finally:
            _remove(folder / BEGUN)


def _write(stage: Path, contents: Mapping[Path, bytes]) -> None:
    with _naming(stage.parent):
        stage.mkdir()
    for path, content in contents.items():
        with _naming(path), open(stage / path.name, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())


def _place(folder: Path) -> None:
    for file in sorted((folder / COMPLETE).iterdir()):
        with _naming(folder / file.name):
            os.replace(file, folder / file.name)
    (folder / COMPLETE).rmdir()


def _remove(folder: Path) -> None:
    if _is_folder(folder):
        shutil.rmtree(folder, ignore_errors=True)


def _is_folder(path: Path) -> bool:
    """Whether it is a folder and no link to one: files behind a link belong to another folder."""
    return path.is_dir() and not path.is_symlink()


@contextmanager
def _lock(path: Path, patience: float) -> Iterator[None]:
    """Hold a lock file, made here and removed at the end; TimeoutError if another process has it for so long [s]."""
    end = time.monotonic() + patience
    while (handle := _open_locked(path)) is None:
        if time.monotonic() >= end:
            raise TimeoutError(errno.ETIMEDOUT, "another process is writing here", str(path.parent))
        time.sleep(0.02)
    try:
        yield
    finally:
        if fcntl is None:  # Windows deletes no open file
            os.close(handle)
        with suppress(OSError):
            path.unlink()
        if fcntl is not None:  # deleted while locked: a process that waits for it sees that and makes a new one
            os.close(handle)


def _open_locked(path: Path) -> int | None:
    """A handle of the lock file, locked; None if another process has it."""
    with _naming(path.parent):
        handle = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0))
    try:
        if fcntl is not None:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        else:
            msvcrt = importlib.import_module("msvcrt")
            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
    except (BlockingIOError, PermissionError):
        os.close(handle)
        return None
    except OSError:
        pass  # a file system without locks: better unlocked than not at all
    if os.fstat(handle).st_nlink == 0:
        os.close(handle)
        return None
    return handle


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Let an OSError name the file that was to be written, not the one it was written as."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from None
