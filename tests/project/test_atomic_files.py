"""Files are written whole or not at all, together or not at all, wherever the writer is killed."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from cz_gym import atomic_files as whole
from cz_gym.atomic_files import BEGUN, COMPLETE, finish_writing, write_files

ROOT = Path(__file__).parents[2]
KILL_AT_EVERY_LINE = """
import os, signal, sys
from pathlib import Path
from cz_gym import atomic_files as whole
folder = Path(sys.argv[1])
names = ("a.json", "b.csv", "c.png")

def killed_at(line):
    child = os.fork()
    if child == 0:
        seen = 0
        def trace(frame, event, argument):
            nonlocal seen
            if frame.f_code.co_filename != whole.__file__:
                return None
            if event == "line":
                seen += 1
                if seen == line:
                    os.kill(os.getpid(), signal.SIGKILL)
            return trace
        sys.settrace(trace)
        whole.write_files({folder / name: b"new" * 1000 for name in names})
        os._exit(0)
    return os.waitpid(child, 0)[1] != 0

def contents():
    return {(folder / name).read_bytes() for name in names}

line, kills, rolled = 0, 0, 0
while True:
    line += 1
    whole.write_files({folder / name: b"old" for name in names})
    if not killed_at(line):
        break
    kills += 1
    whole.finish_writing(folder)
    assert len(contents()) == 1, (line, contents())
    rolled += contents() == {b"new" * 1000}
    assert sorted(path.name for path in folder.iterdir()) == list(names), line
print(kills, rolled)
"""


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_writer_killed_at_any_line_leaves_all_old_or_all_new(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", KILL_AT_EVERY_LINE, str(tmp_path)], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    kills, rolled = map(int, done.stdout.split())
    assert kills > 50
    assert 10 < rolled < kills


def test_several_files_in_several_folders(tmp_path: Path) -> None:
    files = {tmp_path / "one" / "a": b"1", tmp_path / "two" / "deep" / "b": b"2", tmp_path / "one" / "c": b""}
    write_files(files)
    assert {path: path.read_bytes() for path in files} == files
    assert names(tmp_path / "one") == ["a", "c"]


def test_what_a_living_writer_is_writing_is_left_alone(tmp_path: Path) -> None:
    stage = whole._Stage(tmp_path)
    write_files({tmp_path / "other": b"x"})
    assert stage.path.exists()
    stage.unlock()
    finish_writing(tmp_path)
    assert names(tmp_path) == ["other"]


def test_links_are_not_followed(tmp_path: Path) -> None:
    """A folder from a stranger cannot have files moved into or out of others."""
    elsewhere, here = tmp_path / "elsewhere", tmp_path / "here"
    elsewhere.mkdir()
    here.mkdir()
    (elsewhere / "precious").write_text("precious")
    (here / f"{COMPLETE}x").symlink_to(elsewhere)
    (here / f"{BEGUN}x").symlink_to(elsewhere)
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
        patch.setattr(whole.os, call, full)
        with pytest.raises(OSError, match="No space left") as caught:
            write_files({tmp_path / "a": b"new", tmp_path / "b": b"new"})
    assert str(caught.value.filename).startswith(str(tmp_path))
    assert BEGUN not in str(caught.value.filename)
    assert (tmp_path / "a").read_bytes() == b"old"
    assert names(tmp_path) == ["a"]


def test_an_interrupt_leaves_nothing_begun(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*arguments: Any) -> None:
        raise KeyboardInterrupt

    for call, left in (("fsync", [b"old", b"old"]), ("replace", [b"new", b"new"])):
        write_files({tmp_path / "a": b"old", tmp_path / "b": b"old"})
        with monkeypatch.context() as patch:
            patch.setattr(whole.os, call, interrupt)
            with pytest.raises(KeyboardInterrupt):
                write_files({tmp_path / "a": b"new", tmp_path / "b": b"new"})
        finish_writing(tmp_path)
        assert [(tmp_path / name).read_bytes() for name in names(tmp_path)] == left


def test_a_folder_in_a_file_s_place_is_refused(tmp_path: Path) -> None:
    (tmp_path / "b").mkdir()
    with pytest.raises(IsADirectoryError, match="b is a folder"):
        write_files({tmp_path / "a": b"1", tmp_path / "b": b"2"})
    assert names(tmp_path) == ["b"]
