"""Measure what helps: ``python -m studies.ablation`` changes one thing of a recipe at a time."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from studies.comparison.command import main as compare
from studies.comparison.variants import Study

from .rows import ROWS

STUDY = Study("ablation", "What helps: one change of a recipe at a time, cut short", ROWS, None)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return compare(STUDY, arguments)


if __name__ == "__main__":
    sys.exit(main())
