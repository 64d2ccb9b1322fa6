"""The example pages as Jupyter notebooks: ``make notebooks`` writes them into build/notebooks."""

import os
import re
import sys
from pathlib import Path

import jupytext

DOCS = Path(__file__).parent
PAGES = ("first-agent", "extend/controller", "inverse-response", "camera")


def write(folder: Path) -> list[Path]:
    """The notebooks: Python blocks are cells, commands stay text, links and pictures lead where they led."""
    folder.mkdir(parents=True, exist_ok=True)
    written = [folder / f"{Path(page).name}.ipynb" for page in PAGES]
    for page, file in zip(PAGES, written, strict=True):
        there = os.path.relpath((DOCS / page).parent, folder)
        text = (DOCS / f"{page}.md").read_text().replace("```bash", "```text")
        notebook = jupytext.reads(re.sub(r"\]\((?!\w+:|#)", f"]({there}/", text), fmt="md")
        notebook.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
        jupytext.write(notebook, file)
    return written


if __name__ == "__main__":
    print("wrote", *write(Path(sys.argv[1])))
