"""What the project's commands share: whatever is wrong with one, or ends it early, is said in one line."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NoReturn

from gymnasium.error import DependencyNotInstalled

from cz_gym.errors import CzError


class OneLineParser(argparse.ArgumentParser):
    """Takes options only as they are written out, and says in one line what is wrong with them."""

    def __init__(self, prog: str, description: str | None = None, epilog: str | None = None) -> None:
        super().__init__(prog=prog, description=description, epilog=epilog, allow_abbrev=False)

    def error(self, message: str) -> NoReturn:
        """Exit with code 2."""
        self.exit(2, f"{self.prog}: {' '.join(message.split())}\n")

    def run(
        self,
        body: Callable[[argparse.Namespace], int | None],
        arguments: Sequence[str] | None,
        extra: str,
        left: str = "nothing written",
    ) -> int:
        """Run a command's body on what was given, as :func:`guarded` does; returns the exit code."""
        given = self.parse_args(arguments)
        return guarded(self.prog, lambda: body(given) or 0, extra, left)


def between(least: int, most: int) -> Callable[[str], int]:
    """The type of an option that is a whole number in that range, ends included."""

    def number(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if not least <= value <= most:
            raise argparse.ArgumentTypeError(f"must be between {least} and {most}, not {text}")
        return value

    return number


def guarded(prog: str, body: Callable[[], int], extra: str, left: str = "nothing written") -> int:
    """Run a command's body, its exit code; what ends it early is said in one line.

    ``extra`` names the extras of the package that hold what the command imports, ``left`` what an interrupt leaves.
    """
    try:
        return body()
    except ImportError as error:
        absent = isinstance(error, ModuleNotFoundError) and error.name
        said = f'{absent} is missing: pip install ".[{extra}]"' if absent else str(error)
    except OSError as error:
        said = f"{error.filename or 'output'}: {error.strerror}" if error.strerror else str(error)
    except (CzError, DependencyNotInstalled) as error:
        said = str(error)
    except KeyboardInterrupt:
        print(f"{prog}: interrupted; {left}", file=sys.stderr)
        return 130
    print(f"{prog}: {' '.join(said.split())}", file=sys.stderr)
    return 2


def shown(path: str | Path) -> str:
    """A path as people write it: relative to the current folder if it lies below it."""
    whole, here = Path(path).absolute(), Path.cwd()
    return str(whole.relative_to(here) if whole.is_relative_to(here) else whole)


def interpreter() -> str:
    """The Python that runs, as a command names it."""
    return shown(sys.executable) if sys.executable else "python"
