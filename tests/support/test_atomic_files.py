"""Files are written whole or not at all, wherever the writer is killed; errors name the path; one process a folder."""

import errno
import os
import sys

import pytest

from cz_gym.support import files
from cz_gym.support.errors import CzError
from cz_gym.support.files import LOCK, check_writable, locked, name_file_in_errors, write_files
from tests.processes import python

KILL_AT_EVERY_LINE = """
import os, signal, sys
from pathlib import Path
from cz_gym.support import files as atomic_files
folder, names = Path(sys.argv[1]), ("a.json", "b.csv", "z.json")

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

line, seen = 0, set()
while True:
    line += 1
    atomic_files.write_files({folder / name: b"old" for name in names})
    if not killed_at(line):
        break
    found = [(folder / name).read_bytes() for name in names]
    assert {*found} <= {b"old", b"new" * 1000}, (line, found)
    seen.add(sum(each != b"old" for each in found))
    assert found == sorted(found), "files are replaced in the order in which they were given"
print(line, sorted(seen))
"""
"""A writer killed before each line of the module in turn, in a process that forks before every kill."""


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="forks")
def test_a_writer_killed_at_any_line_leaves_every_file_whole_and_the_last_one_last(tmp_path):
    lines, seen = python("-c", KILL_AT_EVERY_LINE, str(tmp_path)).split(maxsplit=1)
    assert int(lines) > 30
    assert seen == "[0, 1, 2, 3]\n"


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_a_full_disk_leaves_what_was_there_and_names_the_file(tmp_path, monkeypatch, call):
    def full(*arguments):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    write_files({tmp_path / "a": b"old"})
    with monkeypatch.context() as patch:
        patch.setattr(files.os, call, full)
        with pytest.raises(CzError, match=rf"^{tmp_path / 'a'}: No space left"):
            write_files({tmp_path / "a": b"new", tmp_path / "b": b"new"})
    assert (tmp_path / "a").read_bytes() == b"old"
    assert names(tmp_path) == ["a"]


@pytest.mark.parametrize(("place", "reason"), [("folder", "is a folder"), ("file/b", "Not a directory|File exists")])
def test_a_place_where_no_file_can_be_is_named(place, reason, tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("")
    with pytest.raises(CzError, match=reason):
        write_files({tmp_path / "a": b"1", tmp_path / place: b"2"})
    assert names(tmp_path) == ["file", "folder"]
    with pytest.raises(CzError, match=r"file is not a folder$"):
        check_writable(tmp_path / "file" / "new")


def test_a_file_that_cannot_be_read_is_named_with_the_reason(tmp_path):
    (tmp_path / "latin").write_bytes(b"\xe9")
    for name, reason in (("none", "No such file or directory"), ("latin", "not a text file in UTF-8")):
        with pytest.raises(CzError, match=f"^{tmp_path / name}: {reason}$"), name_file_in_errors(tmp_path / name):
            (tmp_path / name).read_text("utf-8")
    with pytest.raises(KeyError), name_file_in_errors(tmp_path):
        raise KeyError("any other error passes")


@pytest.mark.slow
def test_a_folder_is_used_by_one_process(tmp_path):
    code = "from cz_gym.support.files import locked\nwith locked(Path(sys.argv[1])): pass"
    code = f"import sys; from pathlib import Path; {code}"
    with locked(tmp_path / "new"):
        with pytest.raises(CzError, match="another process is at work"), locked(tmp_path / "new"):
            pass
        with pytest.raises(AssertionError, match="another process is at work"):
            python("-c", code, str(tmp_path / "new"))
        assert names(tmp_path / "new") == [LOCK]
    assert python("-c", code, str(tmp_path / "new")) == ""
    assert names(tmp_path) == []
    (tmp_path / LOCK).symlink_to(tmp_path / "elsewhere")  # a folder from a stranger has no file made elsewhere
    with pytest.raises(CzError, match=f"^{tmp_path}: "), locked(tmp_path):
        pass
    assert not (tmp_path / "elsewhere").exists()
