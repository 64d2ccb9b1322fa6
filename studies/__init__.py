"""Questions, each answered by one command; nothing in the packages imports them, and no wheel holds them.

Their frame: a command line with ``--out``, a check of that place before the work, and JSON of results.
"""

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

try:  # says in a line what is missing, before a study imports more
    from cz_gym.support.command_line import OneLineParser
    from cz_gym.support.files import check_writable
except KeyboardInterrupt:
    print("interrupted", file=sys.stderr)
    sys.exit(130)


class StudyParser(OneLineParser):
    """Command line of ``python -m studies.NAME``; ``out`` is the default of its option ``--out``, a folder or a file.

    The first line of ``about``, a module's docstring, is the description.
    """

    def __init__(self, name: str, about: str | None, out: str) -> None:
        super().__init__(f"python -m studies.{name}", (about or "").split("\n")[0])
        text = f"{'file' if Path(out).suffix else 'folder'} to write (default: %(default)s)"
        self.add_argument("--out", type=Path, default=Path(out), help=text)

    def run(
        self,
        body: Callable[[argparse.Namespace], int | None],
        arguments: Sequence[str] | None,
        extra: str = "benchmark",
        left: str | Callable[[], str] = "nothing written",
    ) -> int:
        """Run the study if its results can be written; arguments and exit code as of :meth:`OneLineParser.run`."""

        def checked(given: argparse.Namespace) -> int | None:
            check_writable(given.out.parent if given.out.suffix else given.out)
            return body(given)

        return super().run(checked, arguments, extra, left)


def to_json(content: Any, indent: int = 1) -> bytes:
    """Encode results as a JSON file; ValueError for numbers that are not finite."""
    return (json.dumps(content, indent=indent, allow_nan=False) + "\n").encode()
