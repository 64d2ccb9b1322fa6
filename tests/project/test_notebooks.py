"""The example pages as notebooks: valid, of code that compiles, with links that lead somewhere."""

import re
import runpy
from pathlib import Path

import nbformat

DOCS = Path(__file__).parents[2] / "docs"


def test_the_example_pages_become_notebooks(tmp_path):
    made = runpy.run_path(str(DOCS / "notebooks.py"))
    for page, file in zip(made["PAGES"], made["write"](tmp_path), strict=True):
        notebook = nbformat.read(file, as_version=4)
        nbformat.validate(notebook)
        code = [compile(cell.source, str(file), "exec") for cell in notebook.cells if cell.cell_type == "code"]
        assert len(code) == (DOCS / f"{page}.md").read_text().count("```python")
        text = "".join(cell.source for cell in notebook.cells if cell.cell_type == "markdown")
        for link in re.findall(r"\]\(([^)#:]+)[)#]", text):
            assert (tmp_path / link).exists(), link
