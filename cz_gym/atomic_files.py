"""Writing files whole or not at all, also when the writer is killed.

The files of one call are first written into a hidden folder beside their places, ``.writing-...``. Renaming it to
``.written-...`` is the one moment at which the new contents count; then each file moves to its place. Whoever
next writes into a folder finishes the moves of a writer that was killed after that moment, and clears up after one that
was killed before it. A lock on the hidden folder, which dies with its writer, tells the living from the dead.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

BEGUN, COMPLETE = ".writing-", ".written-"
"""What the names of hidden folders begin with."""


def write_files(files: Mapping[Path, bytes]) -> None:
    """Write all files or none; those of one folder are replaced together. Raises OSError naming the file."""
    folders: dict[Path, dict[str, bytes]] = {}
    for path, content in files.items():
        if path.is_dir():
            raise IsADirectoryError(f"{path} is a folder")
        folders.setdefault(path.parent, {})[path.name] = content
    stages: list[_Stage] = []
    try:
        for folder, contents in folders.items():
            folder.mkdir(parents=True, exist_ok=True)
            finish_writing(folder)
            stages.append(_Stage(folder))
            stages[-1].fill(contents)
        for stage in stages:
            stage.complete()
        for stage in stages:
            stage.place()
    except KeyboardInterrupt:
        for stage in stages:
            stage.abandon(unless_complete=True)
        raise
    except BaseException:
        for stage in stages:
            stage.abandon()
        raise
    finally:
        for stage in stages:
            stage.unlock()


def finish_writing(folder: Path) -> None:
    """Finish what killed writers had completed in a folder, and remove what they had not. Raises OSError."""
    with os.scandir(folder) as entries:
        names = [entry.name for entry in entries if entry.name.startswith((BEGUN, COMPLETE))]
    for name in names:
        path = folder / name
        with suppress(FileNotFoundError), _locked(path) as mine:
            if mine and name.startswith(COMPLETE):
                _place(path)
            elif mine:
                shutil.rmtree(path, ignore_errors=True)


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Hold a folder, made if need be, for one process; ValueError if another holds it. Its death lets go of it."""
    folder.mkdir(parents=True, exist_ok=True)
    with _locked(folder) as mine:
        if mine is False:
            raise ValueError(f"{folder}: another process is at work in this folder")
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


class _Stage:
    """The hidden folder of one writer beside the places of its files."""

    def __init__(self, folder: Path) -> None:
        while True:
            with _naming(folder):
                self.path = Path(tempfile.mkdtemp(dir=folder, prefix=BEGUN))
            # Another process may clear up between the folder's making and its lock.
            with suppress(FileNotFoundError):
                self.lock = os.open(self.path, os.O_RDONLY)
                with suppress(OSError):
                    fcntl.flock(self.lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if self.path.exists():
                    return
                os.close(self.lock)

    def fill(self, contents: Mapping[str, bytes]) -> None:
        for name, content in contents.items():
            with _naming(self.path.parent / name), open(self.path / name, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())

    def complete(self) -> None:
        done = self.path.with_name(COMPLETE + self.path.name.removeprefix(BEGUN))
        with _naming(done.parent):
            os.rename(self.path, done)
        self.path = done

    def place(self) -> None:
        _place(self.path)

    def abandon(self, unless_complete: bool = False) -> None:
        if not (unless_complete and self.path.name.startswith(COMPLETE)):
            shutil.rmtree(self.path, ignore_errors=True)

    def unlock(self) -> None:
        os.close(self.lock)


def _place(stage: Path) -> None:
    for file in sorted(stage.iterdir()):
        with _naming(stage.parent / file.name):
            os.replace(file, stage.parent / file.name)
    stage.rmdir()
    _settle(stage.parent)


def _settle(folder: Path) -> None:
    """Have the folder's new names survive a power cut, where the file system can."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


@contextmanager
def _locked(path: Path) -> Iterator[bool | None]:
    """Whether a folder has been locked: nobody who lives holds it. None where the file system has no locks."""
    try:
        handle = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    except OSError:
        yield False
        return
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            free: bool | None = True
        except BlockingIOError:
            free = False
        except OSError:
            free = None
        yield free
    finally:
        os.close(handle)


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Let an OSError name the file that was to be written, not the one it was written as."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from None
