"""``python -m baselines.paper --out results/paper``: Part II of the paper, redone on our plant.

Writes ``report.md``, its figures and ``numbers.json``, and prints the comparison. Each file is written whole or not at
all.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from . import paper_numbers, paper_rows
from .optional import require

DPI = 110
"""Resolution of the figures [dots per inch]."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code, 2 for bad input or a missing package."""
    parser = argparse.ArgumentParser(prog="python -m baselines.paper", description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("results/paper"), help="folder for the results")
    out: Path = parser.parse_args(arguments).out
    if out.exists() and not out.is_dir():
        print(f"baselines.paper: --out must be a folder; {out} is a file", file=sys.stderr)
        return 2
    try:
        for package in ("control", "matplotlib", "tqdm"):
            require(package)
        out.mkdir(parents=True, exist_ok=True)
        results = _compute()
        _write(out, results)
    except (ImportError, OSError) as error:
        print(f"baselines.paper: {error}", file=sys.stderr)
        return 2
    print(paper_rows.as_text(paper_rows.rows(results)))
    print(f"\nreport: {out / 'report.md'}")
    return 0


def _compute() -> paper_numbers.Results:
    """All experiments, with a progress bar that names the stage."""
    with require("tqdm").tqdm(total=paper_numbers.STAGES, unit="stage") as bar:

        def progress(stage: str) -> None:
            bar.update(1 if bar.desc else 0)
            bar.set_description(stage)

        results = paper_numbers.compute(progress)
        bar.update(1)
    return results


def _write(out: Path, results: paper_numbers.Results) -> None:
    """Draw and write everything into a temporary folder, then move the files into place, numbers.json last."""
    from .paper_gallery import FIGURES
    from .paper_report import report

    with tempfile.TemporaryDirectory(dir=out, prefix=".new-") as folder:
        new = Path(folder)
        for figure in FIGURES:
            figure.draw(results).savefig(new / figure.file, dpi=DPI)
        (new / "report.md").write_text(report(results), encoding="utf-8")
        numbers = json.dumps(paper_numbers.numbers(results), indent=2, allow_nan=False)
        (new / "numbers.json").write_text(numbers + "\n", encoding="utf-8")
        for name in (*(figure.file for figure in FIGURES), "report.md", "numbers.json"):
            os.replace(new / name, out / name)


if __name__ == "__main__":
    sys.exit(main())
