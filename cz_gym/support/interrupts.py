"""Ctrl-C while the modules of a command are imported: one line, and exit code 130, as later in the command."""

import sys
from pathlib import Path
from typing import Any


def one_line(kind: Any, error: Any, trace: Any) -> None:
    """Handle an exception that ends a command."""
    if not issubclass(kind, KeyboardInterrupt):
        return sys.__excepthook__(kind, error, trace)
    print("interrupted", file=sys.stderr)
    sys.exit(130)


module = sys.orig_argv[sys.orig_argv.index("-m") + 1] if "-m" in sys.orig_argv[:-1] else ""
script = Path(sys.argv[0]).resolve()
# Other people's programs that import the package keep their traceback.
if module.startswith(("cz_gym.", "studies.")) or (
    script.suffix == ".py" and script.parent == Path(__file__).parents[2]
):
    sys.excepthook = one_line
