"""``python -m studies.paper --out results/paper``: Part II of the paper, redone on our plant.

Writes ``report.md``, its figures and ``numbers.json``, and prints the comparison. Each file is written whole or not at
all.
"""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from cz_gym.atomic_files import check_writable, write_files
from cz_gym.commands import OneLineParser, guarded

from . import numbers as paper_numbers
from . import rows as paper_rows

DPI = 160
"""Resolution of the figures [dots per inch]."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code, 2 for bad input or a missing package."""
    parser = OneLineParser(prog="python -m studies.paper", description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("results/paper"), help="folder for the results")
    out: Path = parser.parse_args(arguments).out
    return guarded(parser.prog, lambda: _compare(out), "benchmark")


def _compare(out: Path) -> int:
    import control  # noqa: F401  (missing? say so before the work, not after it)
    import matplotlib  # noqa: F401

    check_writable(out)
    results = _compute()
    _write(out, results)
    print(paper_rows.as_text(paper_rows.rows(results)))
    print(f"\nreport: {out / 'report.md'}")
    return 0


def _compute() -> paper_numbers.Results:
    """All experiments, with a progress bar that names the stage."""
    from tqdm import tqdm

    with tqdm(total=paper_numbers.STAGES, unit="stage") as bar:

        def progress(stage: str) -> None:
            bar.update(1 if bar.desc else 0)
            bar.set_description(stage)

        results = paper_numbers.compute(progress)
        bar.update(1)
    return results


def _write(out: Path, results: paper_numbers.Results) -> None:
    """Draw everything, then write all files or none."""
    from .gallery import FIGURES
    from .report import report

    files: dict[Path, bytes] = {}
    for figure in FIGURES:
        image = io.BytesIO()
        figure.draw(results).savefig(image, dpi=DPI, format="png")
        files[out / figure.file] = image.getvalue()
    files[out / "report.md"] = report(results).encode()
    numbers = json.dumps(paper_numbers.numbers(results), indent=2, allow_nan=False)
    files[out / "numbers.json"] = f"{numbers}\n".encode()
    write_files(files)


if __name__ == "__main__":
    sys.exit(main())
