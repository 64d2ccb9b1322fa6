"""Writing a benchmark's results, each file whole; files of other origin are replaced only with ``overwrite``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from cz_gym.atomic_files import check_writable, naming, write_files
from cz_gym.errors import CzError
from cz_gym.evaluation.files import EPISODES, FILES, RESULTS, is_benchmark_json, to_csv, to_json
from cz_gym.evaluation.results import Result


def check_targets(folder: Path | None, lone: Path | None, partial: bool, overwrite: bool) -> None:
    """Raise CzError if the results could not be written, or would replace what only ``overwrite`` may."""
    protected = protected_files(folder, lone, partial)
    if protected and not overwrite:
        path, why = protected[0]
        raise CzError(f"{path} exists and {why}: add --overwrite, or name another --out or --json")
    if lone and lone.is_dir():
        raise CzError(f"--json {lone} is a folder")
    for place in (folder, lone and lone.parent):
        if place:
            check_writable(place)


def protected_files(folder: Path | None, lone: Path | None, partial: bool) -> list[tuple[Path, str]]:
    """Return existing files that a run may not replace without ``overwrite``, each with the reason.

    In a folder: any of the benchmark's files, unless a full run renews an earlier benchmark. A lone JSON file: one
    that is no earlier benchmark, and for a partial run one that belongs to a folder of results.
    """
    found = []
    if folder:
        earlier = is_benchmark(folder / RESULTS)
        why = "its folder holds no earlier benchmark" if not earlier else "this run is partial" if partial else ""
        found += [(folder / name, why) for name in FILES if why and (folder / name).exists()]
    if lone and lone.is_file():
        if not is_benchmark(lone):
            found.append((lone, "is no earlier benchmark"))
        elif partial and lone.name == RESULTS and (lone.resolve().parent / "report.md").exists():
            found.append((lone, "this run is partial"))
    return found


def is_benchmark(path: Path) -> bool:
    """Return whether a file is the JSON of an earlier benchmark."""
    with naming(path):
        return path.is_file() and is_benchmark_json(path.read_bytes())


def write(
    folder: Path | None, lone: Path | None, results: Sequence[Result], command: str, quoted: Path | None = None
) -> None:
    """Write the files, ``benchmark.json`` last, and the table between the markers of the page ``quoted``, if it exists.

    Needs matplotlib and plotly if there is a folder.
    """
    text = to_json(results, command).encode()
    files: dict[Path, bytes] = {}
    if folder:
        from .figures import draw_figures
        from .markdown import fill_in, markdown
        from .page import page

        figures = draw_figures(results)
        files |= {folder / name: image for name, image in figures.items()}
        files[folder / EPISODES] = to_csv(results).encode()
        files[folder / "report.md"] = markdown(results, command, figures).encode()
        files[folder / "report.html"] = page(results, command).encode()
        if quoted and quoted.is_file():
            with naming(quoted):
                before = quoted.read_text("utf-8")
            files[quoted] = fill_in(before, results).encode()
        files[folder / RESULTS] = text
    if lone:
        files[lone] = text
    write_files(files)
