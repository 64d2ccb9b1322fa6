"""The example pages as Jupyter notebooks: ``make notebooks`` writes them into build/notebooks."""

import os
import re
import sys
from pathlib import Path

import jupytext
import nbformat

DOCS = Path(__file__).parent
INSTALL = """import subprocess, sys

if "google.colab" in sys.modules:  # elsewhere the package is installed already
    source = "cz-gym[agents,benchmark,render] @ git+https://github.com/cz-gym/cz-gym"
    subprocess.run([sys.executable, "-m", "pip", "install", "-q", source], check=True)"""
"""First cell of each notebook."""
PAGES = ("first-agent", "extend/controller", "inverse-response", "camera")


def write(folder: Path) -> list[Path]:
    """The notebooks: Python blocks are cells, commands stay text, links and pictures lead where they led."""
    folder.mkdir(parents=True, exist_ok=True)
    written = [folder / f"{Path(page).name}.ipynb" for page in PAGES]
    for page, file in zip(PAGES, written, strict=True):
        there = os.path.relpath((DOCS / page).parent, folder)
        text = (DOCS / f"{page}.md").read_text().replace("```bash", "```text")
        notebook = jupytext.reads(re.sub(r"\]\((?!\w+:|#)", f"]({there}/", text), fmt="md")
        notebook.cells.insert(0, nbformat.v4.new_code_cell(INSTALL))
        notebook.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
        jupytext.write(notebook, file)
    return written


if __name__ == "__main__":
    print("wrote", *write(Path(sys.argv[1])))
