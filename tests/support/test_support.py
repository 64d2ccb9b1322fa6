"""Files are written whole or not at all; every command answers a mistake or Ctrl-C in one line."""

import argparse
import errno
import importlib
import os
import re
import subprocess
import sys
import tomllib
from contextlib import suppress
from fractions import Fraction
from pathlib import Path

import pytest
from gymnasium.error import DependencyNotInstalled
from hypothesis import example, given
from hypothesis import strategies as st

import cz_gym_command
from cz_gym import SCENARIOS, __version__
from cz_gym.agents import shipped_names
from cz_gym.crystal.plant import STAGES
from cz_gym.evaluation.protocol import CASES
from cz_gym.support import files
from cz_gym.support.command_line import OPTIONAL, between, run_command
from cz_gym.support.errors import CzError
from cz_gym.support.files import LOCK, check_writable, locked, name_file_in_errors, write_files
from cz_gym.tools import benchmark, datasets, play, tune
from cz_gym.tools.registry import KNOWN
from studies import speed
from studies.paper import __main__ as paper
from tests.conftest import ROOT, python

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


COMMANDS = [
    (benchmark, "--episode", "benchmark", ["--out", "new/folder"]),
    (paper, "--ou", "report", ["--out", "new/folder"]),
    (tune, "--trial", "Search.explore", ["--controller", "pid-conventional", "--out", "new/folder"]),
    (speed, "--qui", "measure", ["--quick"]),
    (play, "--minute", "make_config", []),
    (datasets, "--episode", "record", ["--policies", "paper", "--out", "new/folder"]),
]
"""Each with the beginning of an option, the function that does its work, and arguments that would write a file."""


def interrupt(*arguments, **named):
    raise KeyboardInterrupt


def name(part):
    return getattr(part, "__name__", None)


@pytest.mark.parametrize("abbreviated", [False, True])
@pytest.mark.parametrize(("module", "beginning"), [row[:2] for row in COMMANDS], ids=name)
def test_an_unknown_option_is_refused_in_one_line(module, beginning, abbreviated, refused):
    required = ["--controller", "pid-conventional"] if module is tune else []
    line = refused(module.main, [*required, beginning if abbreviated else "--frobnicate"])
    assert "unrecognized arguments" in line


@pytest.mark.parametrize(
    ("module", "work", "arguments", "writable"),
    [(*row[::2], row[3], True) for row in COMMANDS]
    + [(*row[::2], row[3], False) for row in COMMANDS[1:] if "new/" in str(row[3])],
    ids=name,
)
def test_an_interrupt_and_a_place_that_cannot_be_written_are_one_line_and_leave_nothing(
    module, work, arguments, writable, tmp_path,
    monkeypatch, capsys,
):  # fmt: skip
    """The place is refused before the work."""
    if not writable:
        (tmp_path / "new").write_text("not a folder")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(f"{module.__name__}.{work}", interrupt)
    assert module.main(arguments) == (130 if writable else 2)
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert ("interrupted" if writable else "new is not a folder") in captured.err
    assert [path.name for path in tmp_path.iterdir()] == ([] if writable else ["new"])


@pytest.mark.parametrize(
    "command",
    [
        "-m studies.paper",
        "benchmark.py",
        "train.py",
        "-c import\tsys,cz_gym_command;sys.exit(cz_gym_command.main(['play']))",
        "-c import\tcz_gym",
    ],
)
def test_an_interrupt_while_a_command_is_imported_is_one_line(command, tmp_path):
    """Whoever imports the package from a program of theirs keeps the traceback."""
    (tmp_path / "gymnasium.py").write_text("raise KeyboardInterrupt")
    found = [str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(found)}
    done = subprocess.run([sys.executable, *command.split(" ")], env=environment, capture_output=True, text=True)
    theirs = command == "-c import\tcz_gym"
    assert ((done.returncode, done.stderr) == (130, "interrupted\n")) != theirs
    assert ("Traceback" in done.stderr) == theirs


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["--help"], 0, "usage: cz-gym COMMAND"),
        ([], 0, "usage: cz-gym COMMAND"),
        (["--version"], 0, f"cz-gym {__version__}\n"),
        (["trian"], 2, "cz-gym: unknown command 'trian': did you mean 'train'? Choose from list, train, benchmark"),
        (["tune"], 2, "cz-gym tune: name a --controller, or a --puller to design for"),
    ],
)
def test_a_word_after_cz_gym_is_a_command(words, code, said, capfd):
    assert cz_gym_command.main(words) == code
    assert "".join(capfd.readouterr()).startswith(said)


LEAST, MOST = -(10**3), 10**19
WRITTEN = st.one_of(
    st.integers(2 * LEAST, 2 * MOST).flatmap(lambda n: st.sampled_from([f"{n}", f"{n:_}", f"{n}.0", f"{n:.20e}"])),
    st.builds("{}e{}".format, st.integers(-99, 99), st.integers(-3, 21)),
    st.builds("{}.{}e{}".format, st.integers(0, 99), st.integers(0, 999), st.integers(-3, 19)),
    st.from_regex(r"[-+0-9._eE ]{0,12}", fullmatch=True),
    st.text(max_size=8),
)


@given(WRITTEN)
@example("1e6")
@example("1_000_000")
@example("1e99999999999")
@example("1e-99999999999")
@example("nan")
@example("-inf")
@example("sNaN")
def test_a_whole_number_is_read_as_it_is_written(text):
    """Fractions are the oracle, but for exponents of which they would make numbers of gigabytes."""
    _, sign, exponent = text.lower().rpartition("e")
    value = None
    if not sign or len(exponent) < 5:
        with suppress(ValueError, ZeroDivisionError):
            value = Fraction(text.replace("_", "").replace("/", "?"))
    if value is not None and value.denominator == 1 and LEAST <= value <= MOST:
        assert between(LEAST, MOST)(text) == value
    else:
        with pytest.raises(argparse.ArgumentTypeError, match=", not "):
            between(LEAST, MOST)(text)


def test_an_unknown_list_is_told_with_the_closest_one(capsys):
    assert cz_gym_command.main(["list", "pullres"]) == 2
    assert "did you mean 'pullers'? Choose from controllers, scenarios" in capsys.readouterr().err


@pytest.mark.parametrize("words", [["list"], ["list", "stages", "agents"]])
def test_lists_name_everything_that_commands_take_in_80_columns(words, capsys):
    assert cz_gym_command.main(words) == 0
    said = capsys.readouterr().out
    assert max(map(len, said.splitlines())) <= 80
    names = [re.match(r"  (\S+) ", line)[1] for line in said.splitlines() if re.match(r"  \S", line)]
    known = [*STAGES, *(name for environment in KNOWN for name in shipped_names(environment))]
    if len(words) == 1:
        everyone = [each.name for controllers in KNOWN.values() for each in controllers]
        known = [*everyone, *(each.name for each in CASES), *SCENARIOS, "all", "silicon-300mm", *known]
    assert {*known} == {*names} - {"default", "germanium"}


def test_a_reader_that_has_seen_enough_ends_the_command_quietly():
    """As of ``cz-gym list | head -1``."""
    code = "import cz_gym_command, sys; sys.exit(cz_gym_command.main(['list']))"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        assert process.stderr.read() in (b"", b"cz-gym list: loading its packages\n")
    assert process.returncode == 141


def test_help_comes_before_the_package_is_imported():
    loads = "import sys, cz_gym_command; cz_gym_command.main([]); assert not {'cz_gym', 'numpy'} & {*sys.modules}"
    for word in python("-c", loads).split("\n  ")[1:]:
        importlib.import_module(cz_gym_command.COMMANDS[word.split()[0]][0])


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (None, 0, ""),
        (ModuleNotFoundError("none", name="torch.nn"), 2, 'prog: torch is missing: pip install ".[agents]"\n'),
        (ModuleNotFoundError("", name="distributed"), 2, 'prog: distributed is missing: pip install ".[cluster]"\n'),
        (ModuleNotFoundError("none", name="casadi"), 2, 'prog: casadi is missing: pip install ".[mpc]"\n'),
        (CzError("first line\nsecond line"), 2, "prog: first line second line\n"),
        (DependencyNotInstalled("no pygame"), 2, "prog: no pygame\n"),
        (KeyboardInterrupt(), 130, "prog: interrupted; runs are complete\n"),
        (ModuleNotFoundError("none", name="their_own"), None, ""),
        (ImportError("cannot import name 'one'", name="torch"), None, ""),
        (ValueError("operands could not be broadcast together"), None, ""),
        (FileNotFoundError(2, "No such file", "there.csv"), None, ""),
    ],
    ids=repr,
)
def test_only_what_is_meant_for_the_user_is_one_line_and_a_bug_keeps_its_traceback(error, code, said, capsys):
    def body():
        if error is not None:
            raise error
        return 0

    if code is None and error is not None:
        with pytest.raises(type(error)):
            run_command("prog", body, "agents")
    else:
        assert run_command("prog", body, "agents", "runs are complete") == code
    assert capsys.readouterr().err == said


@pytest.mark.slow
def test_commands_draw_although_a_notebook_names_a_backend_that_is_missing():
    code = "from cz_gym.support.command_line import run_command\ndef body():\n import matplotlib.figure\n return 7"
    named = {**os.environ, "MPLBACKEND": "module://matplotlib_inline.backend_inline"}
    assert python("-W", "error", "-c", f"{code}\nprint(run_command('command', body, 'benchmark'))", env=named) == "7\n"


def test_every_package_of_the_extras_is_known_as_optional():
    project = tomllib.loads(Path("pyproject.toml").read_text())["project"]
    building = {"beautifulsoup4", "ruff", "mypy", "build", "setuptools", "pytest", "pytest_xdist", "hypothesis"}
    building |= {"sybil", "scipy_stubs", "nbclient", "ipykernel"}
    documenting = {"sphinx", "sphinx_copybutton", "myst_parser", "furo", "latex2mathml", "jupytext"}
    optional = project["optional-dependencies"]
    needed = {re.split(r"[^\w-]", line)[0].replace("-", "_") for extra in optional.values() for line in extra}
    assert needed - building - documenting - {"cz_gym", "pygame_ce", "protobuf"} == {*OPTIONAL} - {"h5py"}


FULL = pytest.mark.skipif(not Path("/dev/full").exists(), reason="only Linux has a device that is always full")


@FULL
@pytest.mark.parametrize("words", [["--help"], ["list"]])
def test_a_full_disk_is_told_in_one_line(words):
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "cz_gym", *words]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, cwd=ROOT)
    said = [line for line in done.stderr.splitlines() if not line.endswith("loading its packages")]
    assert done.returncode == 2
    assert len(said) == 1
    assert said[0].endswith("the output cannot be written: No space left on device")


@pytest.mark.slow
def test_a_terminal_of_ascii_shows_question_marks():
    """As of a cron job."""
    env = {name: value for name, value in os.environ.items() if not name.startswith(("LC_", "LANG", "PYTHON"))}
    env |= {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}
    command = [sys.executable, "-m", "cz_gym", "puller", "default"]
    done = subprocess.run(command, capture_output=True, text=True, env=env, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert done.stdout.isascii()
