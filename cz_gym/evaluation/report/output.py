"""Writing a benchmark's results, each file whole."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from cz_gym.atomic_files import check_writable, naming, write_files
from cz_gym.errors import CzError
from cz_gym.evaluation.files import EPISODES, FILES, RESULTS, to_csv, to_json
from cz_gym.evaluation.results import Result


def check_targets(folder: Path | None, lone: Path | None, partial: bool, overwrite: bool) -> None:
    """Raise CzError if the results could not be written, or would replace files without ``overwrite``.

    Only a full run into the folder of an earlier benchmark replaces its files unasked.
    """
    renews = folder is not None and not partial and (folder / RESULTS).is_file()
    theirs = [folder / name for name in FILES] if folder and not renews else []
    found = [path for path in (*theirs, lone) if path and path.exists()]
    if lone and lone.is_dir():
        raise CzError(f"--json {lone} is a folder")
    if found and not overwrite:
        raise CzError(f"{found[0]} exists: add --overwrite, or name another --out or --json")
    for place in (folder, lone and lone.parent):
        if place:
            check_writable(place)


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
