"""The documentation: code blocks run, commands parse, tables are those of the code, and the site needs no network.

Python blocks of a page run in order, in one namespace and a folder of their own. Commands, in shell blocks, indented
blocks and within lines, are parsed by the program they name; shell blocks marked ``run`` are also run.
"""

import importlib
import inspect
import json
import re
import runpy
import shlex
import tomllib
from argparse import ArgumentParser
from contextlib import suppress

import myst_parser  # noqa: F401
import nbformat
import pytest
import sybil
from markdown_it import MarkdownIt
from nbclient import NotebookClient
from sybil.parsers.markdown import CodeBlockParser

import cz_gym_command
from cz_gym import CzEnv
from cz_gym.physics.parameters import describe
from tests.conftest import ROOT, python

DOCS = ROOT / "docs"
NOTEBOOKS = runpy.run_path(str(DOCS / "notebooks.py"))
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "results" / "README.md", *sorted(DOCS.rglob("*.md"))]
SLOW = {
    "docs/paper.md", "docs/extend/meniscus.md", "docs/your-puller.md", "docs/learn/libraries.md", "docs/crystal.md",
    "docs/crystal-agent.md", "docs/camera.md", "docs/first-agent.md",
}  # fmt: skip
SMALL = {
    "num_envs=10_000": "num_envs=100",
    "make_vec_env(1024": "make_vec_env(32",
    "TEST_SEEDS[:50]": "TEST_SEEDS[:2]",
    "TRAINING_SEEDS[:20]": "TRAINING_SEEDS[:2]",
    "VALIDATION_SEEDS[:10]": "VALIDATION_SEEDS[:2]",
    "VALIDATION_SEEDS[:100]": "VALIDATION_SEEDS[:2]",
    "range(3000)": "range(30)",
    "update in range(300)": "update in range(2)",
    "episode in range(20)": "episode in range(2)",
    "learn(9_000_000)": "learn(8192)",
    "seeds=range(20)": "seeds=range(2)",
    "seeds=range(10)": "seeds=range(2)",
    "--scenario randomized --out mine": "--scenario reference-b --episodes 1 --quiet --out mine",
}
"""Replacements that make a block small enough for a test: the same on fewer crystals."""
HEADINGS = (
    "Description, Action Space, Observation Space, Rewards, Starting State, Episode End, Arguments, Version History"
)


def small(text):
    for large, little in SMALL.items():
        text = text.replace(large, little)
    return text


def run_python(example):
    """Run a block where it stands, so that a traceback shows the page's own line."""
    example.namespace.setdefault("__name__", "page")
    text = "\n" * example.line + small(example.parsed)
    exec(compile(text, example.path, "exec", dont_inherit=True), example.namespace)


def blocks(page):
    return list(sybil.Sybil(parsers=[CodeBlockParser("python", run_python)]).parse(page).examples())


def commands(page):
    """The words of each command of a page, and whether it is to be run."""
    programs = ("python", "cz-gym", "pip", "make")
    for token in MarkdownIt().parse(page.read_text()):
        shell = token.type == "fence" and token.info.split()[:1] in (["bash"], ["sh"], ["console"])
        if shell or token.type == "code_block":
            for words in map(_words, token.content.replace("\\\n", " ").splitlines()):
                if words and (shell or words[0] in programs):
                    yield words, "run" in token.info.split()
        for child in token.children or ():
            words = _words(child.content) if child.type == "code_inline" and "<" not in child.content else []
            if len(words) > 1 and words[0] in programs:
                yield words, False


def _words(line):
    """A line without prompt, comment and environment variables."""
    try:
        words = shlex.split(line.strip().removeprefix("$ "), comments=True)
    except ValueError:
        return []
    while words and re.fullmatch(r"[A-Z_]+=.*", words[0]):
        words = words[1:]
    return [words[0].removeprefix(".venv/bin/"), *words[1:]] if words else []


def program(words):
    """This project's module that a python command names, its ``__main__`` where it is a package, and its options."""
    if words[0] == "cz-gym" or words[1] in ("benchmark.py", "train.py"):
        return cz_gym_command, [words[1].removesuffix(".py"), *words[2:]]
    name, options = (words[2], words[3:]) if words[1] == "-m" else (words[1].removesuffix(".py"), words[2:])
    if name == "cz_gym":
        return cz_gym_command, options
    top = name.partition(".")[0]
    if top not in ("cz_gym", "studies"):
        assert importlib.util.find_spec(top) if words[1] == "-m" else (ROOT / words[1]).is_file(), words
        return None
    module = importlib.import_module(name)
    return module if hasattr(module, "main") else importlib.import_module(f"{name}.__main__"), options


class Parsed(BaseException):
    """A command's options were understood."""


@pytest.fixture
def understood(monkeypatch):
    """A function that raises AssertionError or SystemExit for a command that does not exist or has other options."""
    understand = ArgumentParser.parse_args
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]

    def parse_args(parser, args=None, namespace=None):
        understand(parser, args, namespace)
        raise Parsed

    def check(words):
        line = " ".join(words)
        if words[0] == "make":
            assert {word for word in words[1:] if "=" not in word} <= targets, line
        elif words[0] == "pip":
            assert set(re.findall(r"[\w-]+", " ".join(re.findall(r"\[(.*?)\]", line)))) <= set(extras), line
        elif words[0] in ("python", "cz-gym"):
            found = program(words)
            with suppress(Parsed):
                _ = found and found[1][found[0] is cz_gym_command :] and found[0].main(found[1])
        else:
            assert words[0] in ("cd", "git", "mkdir", "tensorboard", "pre-commit"), f"{line}: not a known command"

    monkeypatch.setattr(ArgumentParser, "parse_args", parse_args)
    return check


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=name, marks=[pytest.mark.slow] * (name in SLOW))
        for page in PAGES
        if blocks(page) and (name := str(page.relative_to(ROOT)))
    ],
)
def test_blocks_of_a_page_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    for example in blocks(page):
        example.evaluate()
    for words, runs in commands(page):
        if runs:
            found = program(shlex.split(small(shlex.join(words))))
            assert found is not None
            assert found[0].main(found[1]) == 0, words


def test_commands_of_the_pages_are_understood(understood):
    listed = [words for page in PAGES for words, _ in commands(page)]
    for words in listed:
        understood(words)
    assert len(listed) > 20


def test_every_folder_of_results_is_listed_with_its_command():
    rows = re.findall(r"^\| (`.*?) \|", (ROOT / "results" / "README.md").read_text(), re.MULTILINE)
    listed = [name for row in rows for name in re.findall(r"`([\w-]+)`", row)]
    folders = sorted(each.name for each in (ROOT / "results").iterdir() if each.is_dir() and each.name != "cache")
    assert listed == folders


@pytest.mark.slow
def test_the_site_loads_nothing_from_elsewhere_and_formulas_need_no_script(tmp_path):
    """Warnings of its build are errors, as in ``make docs``."""
    makefile = (ROOT / "Makefile").read_text()
    recipe = re.search(r"^\t\$\(BIN\)/python (-m sphinx --fail-on-warning .*) build/docs$", makefile, re.MULTILINE)
    assert recipe is not None
    python(*recipe[1].split(), str(tmp_path))
    elsewhere = {
        ".html": r"""<(?:link|script|img|source|object)\b[^>]*?(?:href|src|srcset|data)=["'](?:https?:)?//[^>]*>"""
        r"|MathJax|\$\$",
        ".css": r"@import[^;]*//|url\(\s*['\"]?(?:https?:)?//",
        ".js": r"\b(?:cdn|unpkg|jsdelivr|googleapis|cloudflare)\b",
    }
    formulas = 0
    for file in tmp_path.rglob("*.*"):
        if file.suffix in elsewhere:
            text = file.read_text()
            assert re.findall(elsewhere[file.suffix], text) == [], file
            formulas += text.count("<math")
    assert formulas > 100
    titles = json.loads((tmp_path / "searchindex.js").read_text().removeprefix("Search.setIndex(").rstrip(")"))[
        "alltitles"
    ]
    assert {"Install", "GPU", "Licence", "Rewards", "Seeds"} <= set(titles)
    values = [page for page in (tmp_path / "docs" / "api").glob("*.html") if "functools.partial(" in page.read_text()]
    assert values == [], "a constant's value is printed"


def test_every_figure_is_drawn_by_the_code_and_stands_on_a_page(monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS))
    figures = importlib.import_module("czdocs.figures")
    text = "".join(page.read_text() for page in PAGES)
    drawn = (
        [f"{name}.svg" for name in figures.FIGURES] + [f"bode-{name}.png" for name in figures.BODE] + ["picture.png"]
    )
    for name in drawn:
        assert (figures.FOLDER / name).stat().st_size < 100_000, f"{name}: make figures"
        assert f"_static/{name})" in text, f"{name} stands on no page"
    assert figures.furnace().axes[0].patches
    assert figures.loop().axes[0].patches


def test_the_environment_page_has_gymnasiums_headings_and_the_arguments_as_they_are():
    text = (DOCS / "environment.md").read_text()
    assert ", ".join(re.findall(r"^## (.*)$", text, re.MULTILINE)) == HEADINGS
    rows = re.findall(r"^\| `(\w+)` \| `([^`]*)` \|", text[text.index("## Arguments") :], re.MULTILINE)
    arguments = [each for each in inspect.signature(CzEnv).parameters.values() if each.kind is not each.VAR_KEYWORD]
    assert list(rows) == [(each.name, repr(each.default).replace("'", '"')) for each in arguments]


def test_pages_read_well_on_github_and_their_tables_are_the_code_s(monkeypatch):
    """Only the pages of the code's own names, and the site's contents, have blocks that GitHub shows as they stand."""
    monkeypatch.syspath_prepend(str(DOCS))
    tables = importlib.import_module("czdocs.tables")
    text = "".join(page.read_text() for page in PAGES)
    assert set(tables.TABLES) == set(re.findall(r"<!-- table:(?!end)([\w-]+) -->", text))
    for page in PAGES:
        text = page.read_text()
        bare = re.findall(r"^ *(?:\$ )?python (?:-m|\w+\.py) ?.*", text, re.MULTILINE)
        assert bare == [], f"{page}: .venv/bin/python"
        assert tables.filled(text) == text, f"{page}: make tables"
        blocks = set(re.findall(r"^```\{([\w-]+)\}", text, re.MULTILINE))
        allowed = {"eval-rst"} if page.parent.name == "api" else {"toctree"} if page == tables.CONTENTS else set()
        assert blocks <= allowed


def test_every_symbol_has_unit_meaning_and_a_numbered_equation(monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS))
    nomenclature = importlib.import_module("czdocs.nomenclature")
    assert list(nomenclature.formulas()) == [str(number + 1) for number in range(len(nomenclature.formulas()))]
    for part in ("states", "inputs", "parameters", "derived"):
        for row in nomenclature.ROWS[part]():
            assert row.unit, row
            assert row.meaning, row
            assert row.equations, f"{row.code}: no numbered equation of docs/physics.md holds {row.symbol}"
    sources = {row.code: row.source for row in nomenclature.parameters()}
    assert sources == {name: quantity.source for name, quantity in describe().items()}


def test_the_example_pages_become_notebooks(tmp_path):
    """Their cells are the pages' blocks, which run above, after one that installs the package where Colab runs it."""
    for page, file in zip(NOTEBOOKS["PAGES"], NOTEBOOKS["write"](tmp_path), strict=True):
        notebook = nbformat.read(file, as_version=4)
        nbformat.validate(notebook)
        first, *code = [cell.source for cell in notebook.cells if cell.cell_type == "code"]
        exec(first, {})
        written = re.findall(r"^```python.*?\n(.*?)^```$", (DOCS / f"{page}.md").read_text(), re.DOTALL | re.MULTILINE)
        assert code == [block.strip("\n") for block in written]
        text = "".join(cell.source for cell in notebook.cells if cell.cell_type == "markdown")
        for link in re.findall(r"\]\(([^)#:]+)[)#]", text):
            assert (tmp_path / link).exists(), link


@pytest.mark.slow
@pytest.mark.parametrize("page", NOTEBOOKS["PAGES"])
def test_a_notebook_runs_as_one(page, tmp_path, monkeypatch):
    """In a kernel of its own, as Colab runs it, at the size of the page's test; commands are text there."""
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path))
    file = NOTEBOOKS["write"](tmp_path)[NOTEBOOKS["PAGES"].index(page)]
    notebook = nbformat.reads(small(file.read_text()), as_version=4)
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(tmp_path)}}).execute()
    assert all(cell.execution_count for cell in notebook.cells if cell.cell_type == "code")
