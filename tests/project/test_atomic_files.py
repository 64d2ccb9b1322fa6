"""Files are replaced together or not at all, wherever the writer is killed, on every system."""

import errno
import os
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from cz_gym import atomic_files
from cz_gym.atomic_files import BEGUN, COMPLETE, WRITER, finish_writing, locked, write_files
from tests.processes import python

ALONE = f"""
import importlib.util, os, signal, sys
from pathlib import Path
spec = importlib.util.spec_from_file_location("atomic_files", {atomic_files.__file__!r})
atomic_files = importlib.util.module_from_spec(spec)
spec.loader.exec_module(atomic_files)
folder = Path(sys.argv[1])
"""
"""The module without its package, whose import takes seconds."""
KILL_AT_EVERY_LINE = """
names = ("a.json", "b.csv", "c.png")

def killed_at(line):
    child = os.fork()
    if child == 0:
        seen = 0
        def trace(frame, event, argument):
            nonlocal seen
            if frame.f_code.co_filename != atomic_files.__file__:
                return None
            if event == "line":
                seen += 1
                if seen == line:
                    os.kill(os.getpid(), signal.SIGKILL)
            return trace
        sys.settrace(trace)
        atomic_files.write_files({folder / name: b"new" * 1000 for name in names})
        os._exit(0)
    return os.waitpid(child, 0)[1] != 0

def contents():
    return {(folder / name).read_bytes() for name in names}

line, kills, finished = 0, 0, 0
while True:
    line += 1
    atomic_files.write_files({folder / name: b"old" for name in names})
    if not killed_at(line):
        break
    kills += 1
    atomic_files.finish_writing(folder)
    assert len(contents()) == 1, (line, contents())
    finished += contents() == {b"new" * 1000}
    assert sorted(path.name for path in folder.iterdir()) == list(names), line
print(kills, finished)
"""
AS_ON_WINDOWS = """
import fcntl, os, sys, types
from pathlib import Path
sys.modules["fcntl"] = None
del os.getuid
opened, os_open, os_close, os_unlink = {}, os.open, os.close, os.unlink

def locking(handle, mode, size):
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise PermissionError(13, "Permission denied")

def open_and_note(path, *others, **named):
    handle = os_open(path, *others, **named)
    opened[handle] = os.fspath(path)
    return handle

def close(handle):
    opened.pop(handle, None)
    os_close(handle)

def unlink(path, **named):
    if os.fspath(path) in opened.values():
        raise PermissionError(32, "being used by another process", path)
    os_unlink(path, **named)

import cz_gym, cz_gym.agents, cz_gym.baselines, cz_gym.evaluation.runner
from cz_gym.atomic_files import locked, write_files
sys.modules["msvcrt"] = types.SimpleNamespace(locking=locking, LK_NBLCK=2)
os.open, os.close, os.unlink = open_and_note, close, unlink
folder = Path(sys.argv[1])
with locked(folder):
    try:
        with locked(folder):
            print("two at once")
    except ValueError as error:
        print("another process" in str(error))
    write_files({folder / "a": b"1", folder / "b": b"2"})
print(sorted(path.name for path in folder.iterdir()))
"""


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.skipif(sys.platform == "win32", reason="forks, or feigns Windows")
def test_a_writer_killed_at_any_line_leaves_all_old_or_all_new(tmp_path: Path) -> None:
    kills, finished = map(int, python("-c", ALONE + KILL_AT_EVERY_LINE, str(tmp_path)).split())
    assert kills > 50
    assert 10 < finished < kills


@pytest.mark.skipif(sys.platform == "win32", reason="forks, or feigns Windows")
def test_it_works_as_on_windows(tmp_path: Path) -> None:
    """Without ``fcntl`` and user numbers, and where a file that is open cannot be deleted."""
    assert python("-c", AS_ON_WINDOWS, str(tmp_path / "new")) == "True\n['a', 'b']\n"


def test_several_files_in_several_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    files = {Path("one/a"): b"1", tmp_path / "two" / "deep" / "b": b"2", tmp_path / "one" / "c": b""}
    write_files(files)
    assert {path: path.read_bytes() for path in files} == files
    assert names(tmp_path / "one") == ["a", "c"]


def test_a_writer_waits_for_another_but_not_for_ever(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writer = threading.Thread(target=write_files, args=({tmp_path / "other": b"x"},))
    waits, sleep = threading.Event(), time.sleep
    monkeypatch.setattr(atomic_files.time, "sleep", lambda seconds: (waits.set(), sleep(seconds)))
    with atomic_files._writer(tmp_path, ()):
        (tmp_path / BEGUN).mkdir()
        writer.start()
        assert waits.wait(60.0), "it has tried the lock once"
        assert names(tmp_path) == [WRITER, BEGUN]
        monkeypatch.setattr(atomic_files, "PATIENCE", 0.0)
        with pytest.raises(OSError, match="another process is writing here"):
            finish_writing(tmp_path)
    writer.join()
    assert names(tmp_path) == ["other"]


def test_a_folder_is_used_by_one_process(tmp_path: Path) -> None:
    code = ALONE + "with atomic_files.locked(folder): pass"
    with locked(tmp_path / "new"):
        with pytest.raises(ValueError, match="another process is at work"), locked(tmp_path / "new"):
            pass
        with pytest.raises(AssertionError, match="another process is at work"):
            python("-c", code, str(tmp_path / "new"))
    assert python("-c", code, str(tmp_path / "new")) == ""
    assert names(tmp_path / "new") == []


def test_links_are_not_followed(tmp_path: Path) -> None:
    """A folder from a stranger cannot have files moved into or out of others."""
    elsewhere, here = tmp_path / "elsewhere", tmp_path / "here"
    elsewhere.mkdir()
    here.mkdir()
    (elsewhere / "precious").write_text("precious")
    for name in (BEGUN, COMPLETE):
        (here / name).symlink_to(elsewhere)
    finish_writing(here)
    (here / WRITER).symlink_to(elsewhere / "precious")
    with pytest.raises(OSError, match="here"):
        finish_writing(here)
    assert (elsewhere / "precious").read_text() == "precious"
    assert not (here / "precious").exists()


@pytest.mark.parametrize("call", ["fsync", "rename", "replace"])
def test_a_full_disk_leaves_what_was_there_and_names_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    def full(*arguments: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    write_files({tmp_path / "a": b"old"})
    with monkeypatch.context() as patch:
        patch.setattr(atomic_files.os, call, full)
        with pytest.raises(OSError, match="No space left") as caught:
            write_files({tmp_path / "a": b"new", tmp_path / "b": b"new"})
    assert str(caught.value.filename).startswith(str(tmp_path))
    assert BEGUN not in str(caught.value.filename)
    assert (tmp_path / "a").read_bytes() == b"old"
    assert names(tmp_path) == ["a"]


def test_a_writer_that_fails_halfway_through_is_finished_by_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    replace = os.replace

    def once(source: Any, target: Any) -> None:
        if Path(target).name == "b":
            raise PermissionError(errno.EACCES, "Permission denied")
        replace(source, target)

    write_files({tmp_path / "a": b"old", tmp_path / "b": b"old"})
    with monkeypatch.context() as patch:
        patch.setattr(atomic_files.os, "replace", once)
        with pytest.raises(PermissionError) as caught:
            write_files({tmp_path / "a": b"new", tmp_path / "b": b"new"})
    assert caught.value.filename == str(tmp_path / "b")
    write_files({tmp_path / "c": b"new"})
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == dict.fromkeys("abc", b"new")


def test_a_folder_in_a_file_s_place_is_refused(tmp_path: Path) -> None:
    (tmp_path / "b").mkdir()
    with pytest.raises(IsADirectoryError, match="b is a folder"):
        write_files({tmp_path / "a": b"1", tmp_path / "b": b"2"})
    assert names(tmp_path) == ["b"]
