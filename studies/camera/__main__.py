"""The camera's view, measured and drawn in about a minute: ``python -m studies.camera``."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from cz_gym.atomic_files import check_writable, write_files
from cz_gym.commands import OneLineParser

from .measurements import MODELS, PULLS, make_bench, numbers, respond


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser("python -m studies.camera", "Measure the camera's view and draw it.")
    parser.add_argument("--out", type=Path, default=Path("results/camera"), metavar="FOLDER", help="%(default)s")
    return parser.run(_study, arguments, "benchmark")


def _study(given: argparse.Namespace) -> None:
    from .figures import response_figure, section_figure, view_figure

    check_writable(given.out)
    bench = make_bench()
    responses = [respond(bench, model, change) for change in PULLS for model in MODELS]
    text = json.dumps(numbers(bench, responses), indent=1, allow_nan=False) + "\n"
    files = {
        "camera.json": text.encode(),
        "view.png": view_figure(bench),
        "section.png": section_figure(bench),
        "response.png": response_figure(responses),
    }
    write_files({given.out / name: content for name, content in files.items()})
    print(text, end="")


if __name__ == "__main__":
    sys.exit(main())
