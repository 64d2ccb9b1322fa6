"""Command lines of the project: an error that is meant for the user, or an interrupt, prints one line."""

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from decimal import Decimal, InvalidOperation
from io import TextIOWrapper
from pathlib import Path
from shutil import get_terminal_size
from textwrap import fill
from typing import Any, NoReturn

from gymnasium.error import DependencyNotInstalled

from .errors import CzError

OPTIONAL = (
    "aiohttp", "array_api_compat", "asyncua", "blark", "casadi", "control", "cryptography", "distributed", "envpool",
    "filelock", "fmpy", "h5py", "matplotlib", "minari", "onnx", "onnxruntime", "pandas", "pillow", "pyarrow", "pygame",
    "pythonfmu", "sb3_contrib", "selenium", "skrl", "stable_baselines3", "tensorboard", "torch", "torchrl", "tqdm",
)  # fmt: skip
"""Modules of the packages in the extras of ``pyproject.toml``."""
OWN_EXTRA = {"distributed": "cluster", "casadi": "mpc"}
"""Extras of modules that an option of a command needs, and not the command."""


class OneLineParser(argparse.ArgumentParser):
    """Parser of a command line without abbreviated options, whose error messages are one line each."""

    def __init__(self, prog: str, description: str | None = None, epilog: str | None = None) -> None:
        super().__init__(prog=prog, description=description, epilog=epilog, allow_abbrev=False)

    def error(self, message: str) -> NoReturn:
        """Exit with code 2."""
        self.exit(2, f"{self.prog}: {' '.join(message.split())}\n")

    def add_puller(self, use: str = "run on it") -> None:
        """Add the option ``--puller``."""
        about = f"puller file, or the name of a shipped one: {use} (docs/extend/puller.md)"
        self.add_argument("--puller", metavar="FILE.toml", help=about)

    def add_scenario(self, about: str, default: str | None = None, several: bool = False) -> None:
        """Add the option ``--scenario``, whose text :func:`cz_gym.evaluation.protocol.scenarios` reads.

        With ``several`` it gives a list, of every time that it is named and of names with commas between.
        """
        ways: dict[str, Any] = {"default": default, "metavar": "NAME", "help": f"{about} (cz-gym list scenarios)"}
        if several:
            ways |= {"type": names, "action": "extend", "metavar": "NAME[,NAME]"}
        self.add_argument("--scenario", *(["--scenarios"] if several else []), dest="scenario", **ways)

    def add_cluster(self) -> None:
        """Add the option ``--cluster``."""
        about = (
            "Dask scheduler whose workers run the tasks, tcp://HOST:8786, in place of this machine (docs/cluster.md)"
        )
        self.add_argument("--cluster", metavar="ADDRESS", help=about)

    def run(
        self,
        body: Callable[[argparse.Namespace], int | None],
        arguments: Sequence[str] | None,
        extra: str,
        left: str | Callable[[], str] = "nothing written",
    ) -> int:
        """Parse the arguments and run the command's body on them (:func:`run_command`); return the exit code."""
        given = self.parse_args(arguments)
        return run_command(self.prog, lambda: body(given) or 0, extra, left)


def names(text: str) -> list[str]:
    """Return names with commas between, each once, for an option's ``type``; a file's name may have commas itself."""
    file, colon, name = text.rpartition(":")
    if Path(file if colon and "," not in name else text).is_file():
        return [text]
    listed = list(dict.fromkeys(name.strip() for name in text.split(",")))
    if not all(listed):
        raise argparse.ArgumentTypeError(f"must be names with commas between, not {text!r}")
    return listed


def between(least: int, most: int) -> Callable[[str], int]:
    """Return a parser of whole numbers from ``least`` to ``most``, for an option's ``type``.

    It takes numbers as people write them: 1000000, 1_000_000, 1e6.
    """

    def number(text: str) -> int:
        try:
            value = Decimal(text)
        except InvalidOperation:
            value = Decimal("nan")
        whole = int(value) if value.is_finite() and least <= value <= most else None
        if whole is None or whole != value:
            raise argparse.ArgumentTypeError(f"must be a whole number between {least} and {most}, not {text}")
        return whole

    return number


def run_command(
    prog: str, body: Callable[[], int], extra: str, left: str | Callable[[], str] = "nothing written"
) -> int:
    """Run a command's body and return its exit code.

    One line on stderr tells of a :class:`CzError`, a missing package of the project's extras, Ctrl-C, and of an output
    that cannot be written; a closed pipe of stdout ends the command quietly; every other exception is a bug, the user's
    or ours, and keeps its traceback. Characters that the terminal's encoding lacks become question marks.
    ``extra`` names the extras of what the command imports, ``left`` says what an interrupt leaves behind.
    """
    # Commands draw files: a notebook's backend may be missing here, and a user's matplotlibrc is for other figures.
    os.environ |= {"MPLBACKEND": "agg", "CZ_GYM_COMMAND": prog}
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        code = body()
        sys.stdout.flush()
        return code
    except (CzError, DependencyNotInstalled) as error:
        message = str(error)
    except ModuleNotFoundError as error:
        module = (error.name or "").partition(".")[0]
        if module not in OPTIONAL:
            raise
        message = missing(module, extra)
    except OSError as error:
        try:
            print(flush=True)  # fails again if it was stdout
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            if isinstance(error, BrokenPipeError):  # its reader has seen enough, as head has
                return 141
            message = f"the output cannot be written: {error.strerror}"
        else:
            raise
    except KeyboardInterrupt:
        print(f"{prog}: interrupted; {left if isinstance(left, str) else left()}", file=sys.stderr)
        return 130
    print(f"{prog}: {' '.join(message.split())}", file=sys.stderr)
    return 2


def missing(module: str, extra: str) -> str:
    """Return the line on a package that is not installed; ``extra`` names the extras of the command."""
    own = "." if (Path(__file__).parents[2] / "pyproject.toml").is_file() else "cz-gym"
    return f'{module} is missing: pip install "{own}[{OWN_EXTRA.get(module, extra)}]"'


def filled(text: str, begin: str = "", rest: str = "") -> str:
    """Return a text in lines of the terminal's width, behind ``begin`` in the first one and ``rest`` in the others."""
    width = get_terminal_size().columns
    return fill(
        text, width, initial_indent=begin, subsequent_indent=rest, break_on_hyphens=False, break_long_words=False
    )


def relative_path(path: str | Path) -> str:
    """Return the path relative to the current folder if it lies below it, else absolute."""
    whole, here = Path(path).absolute(), Path.cwd()
    return str(whole.relative_to(here) if whole.is_relative_to(here) else whole)


def interpreter() -> str:
    """Return the path of the running Python as a command line would name it."""
    return relative_path(sys.executable) if sys.executable else "python"
