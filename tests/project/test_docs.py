"""The documentation: every code block runs, every command parses, and the site says what the code says.

Python blocks of a page run in order, in one namespace of its own and a folder of its own. Commands, in shell blocks,
indented blocks and within lines, are parsed by the program they name; shell blocks marked ``run`` are also run.
"""

from __future__ import annotations

import importlib
import inspect
import re
import shlex
import subprocess
import sys
import tomllib
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import pytest

pytest.importorskip("sphinx")
pytest.importorskip("myst_parser")
sybil = pytest.importorskip("sybil")
from markdown_it import MarkdownIt  # noqa: E402
from sybil.parsers.markdown import CodeBlockParser  # noqa: E402

import cz_gym  # noqa: E402
from cz_gym import (  # noqa: E402
    SCENARIOS,
    CzEnv,
    Parameters,
    Puller,
    State,
    baselines,
)
from cz_gym.engine.layout import INFO  # noqa: E402
from cz_gym.observation import OBSERVATIONS  # noqa: E402
from cz_gym.physics.parameters import describe  # noqa: E402
from cz_gym.physics.plant import Disturbance, Inputs  # noqa: E402

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
SMALL = {
    "num_envs=10_000": "num_envs=100",
    "TEST_SEEDS[:50]": "TEST_SEEDS[:2]",
    "TRAINING_SEEDS[:20]": "TRAINING_SEEDS[:2]",
    "VALIDATION_SEEDS[:10]": "VALIDATION_SEEDS[:2]",
    "seeds=range(20)": "seeds=range(2)",
    "seeds=range(10)": "seeds=range(2)",
    "--scenarios randomized --out mine": "--scenarios reference-b --episodes 1 --quiet --out mine",
}
"""What a block asks for, and what its test does: the same on fewer crystals."""
SHELL = ("bash", "sh", "shell", "console")
PROGRAMS = ("python", "pip", "make")
ELSEWHERE = ("cd", "git", "mkdir", "tensorboard")
"""Commands of a page that are not this project's."""
HEADINGS = [
    "Description", "Action Space", "Observation Space", "Rewards", "Starting State", "Episode End", "Arguments",
    "Version History",
]  # fmt: skip


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


def small(text: str) -> str:
    for large, little in SMALL.items():
        text = text.replace(large, little)
    return text


def run_python(example: Any) -> None:
    """Run a block where it stands, so that a traceback shows the page's own line."""
    example.namespace.setdefault("__name__", "page")
    text = "\n" * example.line + small(example.parsed)
    exec(compile(text, example.path, "exec", dont_inherit=True), example.namespace)


def blocks(page: Path) -> list[Any]:
    document = sybil.Sybil(parsers=[CodeBlockParser("python", run_python)]).parse(page)
    return list(document.examples())


class Parsed(BaseException):
    """A command's options were understood."""


@cache
def targets() -> set[str]:
    return set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))


@cache
def extras() -> set[str]:
    return set(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"])


def commands(page: Path) -> Iterator[tuple[str, bool]]:
    """Each command of a page, and whether it is to be run."""
    for token in MarkdownIt().parse(page.read_text()):
        if token.type == "fence" and token.info.split()[:1] and token.info.split()[0] in SHELL:
            for line in _lines(token.content):
                yield line, "run" in token.info.split()
        elif token.type == "code_block":
            for line in _lines(token.content):
                if _words(line)[:1] and _words(line)[0] in PROGRAMS:
                    yield line, False
        for child in token.children or ():
            code = child.content
            if child.type == "code_inline" and code.startswith(("python ", "make ", "pip ")) and "<" not in code:
                yield code, False


def _lines(text: str) -> list[str]:
    joined = text.replace("\\\n", " ").splitlines()
    return [line.removeprefix("$ ").strip() for line in joined if line.strip() and not line.lstrip().startswith("#")]


def _words(line: str) -> list[str]:
    try:
        words = shlex.split(line, comments=True)
    except ValueError:
        return []
    while words and re.fullmatch(r"[A-Z_]+=.*", words[0]):
        words = words[1:]
    return [words[0].removeprefix(".venv/bin/"), *words[1:]] if words else []


def program(words: list[str]) -> tuple[Any, list[str]] | None:
    """This project's module that a python command names, and its options; None for another's."""
    if words[1] == "-m":
        name, options = words[2], words[3:]
        if importlib.util.find_spec(name.partition(".")[0]) is None:
            pytest.fail(f"no module {name}")
    else:
        name, options = words[1].removesuffix(".py"), words[2:]
        assert (ROOT / words[1]).is_file(), f"no program {words[1]}"
    ours = name.partition(".")[0] in {"cz_gym", "studies", "benchmark", "train"}
    return (_with_main(name), options) if ours else None


def _with_main(name: str) -> Any:
    """The module of that name, or the one that runs for a package of that name."""
    module = importlib.import_module(name)
    return module if hasattr(module, "main") else importlib.import_module(f"{name}.__main__")


def check_command(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    words = _words(line)
    if words[0] == "make":
        asked = [word for word in words[1:] if "=" not in word]
        assert set(asked) <= targets(), line
    elif words[0] == "pip":
        assert words[1] == "install", line
        named = {name.strip() for group in re.findall(r"\[([^\]]*)\]", line) for name in group.split(",")}
        assert named <= extras(), line
    elif words[0] == "python":
        found = program(words)
        if found is not None and found[1]:
            parses(*found, line, monkeypatch)
    else:
        assert words[0] in ELSEWHERE, f"{line}: not a command this test knows"


def parses(module: Any, options: list[str], line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The module's own parser takes these options."""
    understand = ArgumentParser.parse_args

    def parse_args(parser: ArgumentParser, args: Any = None, namespace: Any = None) -> Namespace:
        understand(parser, args, namespace)
        raise Parsed

    monkeypatch.setattr(ArgumentParser, "parse_args", parse_args)
    try:
        with pytest.raises(Parsed):
            module.main(options)
    except SystemExit:
        pytest.fail(f"{line}: its options are not understood")
    finally:
        monkeypatch.setattr(ArgumentParser, "parse_args", understand)


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page)], ids=name_of)
def test_blocks_of_a_page_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    found = blocks(page)
    for example in found:
        example.evaluate()
    for line, runs in commands(page):
        if runs:
            found_program = program(_words(small(line)))
            assert found_program is not None, line
            module, options = found_program
            assert module.main(options) == 0, line
    print(f"{name_of(page)}: {len(found)} blocks")


def test_commands_of_the_pages_are_understood(monkeypatch: pytest.MonkeyPatch) -> None:
    listed = [line for page in PAGES for line, _ in commands(page)]
    for line in listed:
        check_command(line, monkeypatch)
    print(f"{len(listed)} commands")
    assert len(listed) > 20


@pytest.mark.parametrize(
    "line",
    [
        "make everything",
        "python benchmark.py --episode 5",
        'pip install "cz-gym[nothing]"',
        "python -m studies.paper --no",
        "frobnicate",
    ],
)
def test_commands_that_do_not_exist_are_noticed(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises((AssertionError, pytest.fail.Exception)):
        check_command(line, monkeypatch)


def test_every_small_variant_is_of_use() -> None:
    text = "\n".join(page.read_text() for page in PAGES)
    assert [large for large in SMALL if large not in text] == []


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site: warnings are errors, as in ``make docs``."""
    folder = tmp_path_factory.mktemp("site")
    recipe = re.search(r"^\t\$\(BIN\)/python -m sphinx (.*) build/docs$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert recipe is not None
    assert "--fail-on-warning" in recipe.group(1)
    command = [sys.executable, "-m", "sphinx", *recipe.group(1).split(), str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder


class Page(HTMLParser):
    """What a page of the site loads, where it leads, its anchors and its text."""

    def __init__(self, file: Path) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.formulas = 0
        self.words: list[str] = []
        self.feed(file.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.formulas += tag == "math"
        self.anchors.add(given.get("id") or "")
        address = given.get("href") or given.get("src") or given.get("srcset") or given.get("data")
        if address and tag == "a":
            self.links.append(address)
        elif address:
            self.loads.append(address)

    def handle_data(self, data: str) -> None:
        self.words.append(data)


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, Page]:
    return {file: Page(file) for file in sorted(site.rglob("*.html"))}


def test_the_site_loads_nothing_from_elsewhere(site: Path, pages: dict[Path, Page]) -> None:
    for file, page in pages.items():
        assert [address for address in page.loads if urlsplit(address).netloc] == [], file
    for file in [*site.rglob("*.css"), *site.rglob("*.html")]:
        text = file.read_text()
        assert re.findall(r"@import[^;]*//|url\(\s*['\"]?(?:https?:)?//", text) == [], file
    for file in site.rglob("*.js"):
        assert re.findall(r"\b(?:cdn|unpkg|jsdelivr|googleapis|cloudflare)\b", file.read_text()) == [], file


def test_formulas_need_no_script(pages: dict[Path, Page]) -> None:
    assert sum(page.formulas for page in pages.values()) > 100
    for file, page in pages.items():
        assert not any("MathJax" in word or "$$" in word for word in page.words), file


def test_links_within_the_site_lead_somewhere(site: Path, pages: dict[Path, Page]) -> None:
    for file, page in pages.items():
        for address in [*page.links, *page.loads]:
            parts = urlsplit(address)
            if parts.scheme or parts.netloc:
                continue
            goal = (file.parent / unquote(parts.path)).resolve() if parts.path else file
            assert goal.is_relative_to(site), f"{file.relative_to(site)}: {address}"
            assert goal.is_file(), f"{file.relative_to(site)}: {address}"
            if parts.fragment and goal in pages:
                assert unquote(parts.fragment) in pages[goal].anchors, f"{file.relative_to(site)}: {address}"


def test_the_environment_page_is_complete(pages: dict[Path, Page], site: Path) -> None:
    text = (DOCS / "environment.md").read_text()
    assert re.findall(r"^## (.*)$", text, re.MULTILINE) == HEADINGS
    words = {word.strip() for word in pages[site / "docs" / "environment.html"].words}
    assert set(INFO) <= words
    assert set(SCENARIOS) <= words
    assert {channel.name for mode in ("measured", "state") for channel in OBSERVATIONS[mode]} <= words
    assert {str(index) for index in range(len(OBSERVATIONS["history"]))} <= words


def test_the_environment_page_has_the_arguments_as_they_are() -> None:
    text = (DOCS / "environment.md").read_text()
    rows = re.findall(r"^\| `(\w+)` \| `([^`]*)` \|", text[text.index("## Arguments") :], re.MULTILINE)
    arguments = inspect.signature(CzEnv).parameters
    assert list(rows) == [(name, repr(given.default).replace("'", '"')) for name, given in arguments.items()]


@pytest.fixture(scope="module")
def nomenclature() -> Iterator[Any]:
    sys.path.insert(0, str(DOCS))
    yield importlib.import_module("czdocs.nomenclature")
    sys.path.remove(str(DOCS))


def test_a_scenario_that_is_added_appears_among_the_others(nomenclature: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    tables = importlib.import_module("czdocs.tables").TABLES
    before = {name: tables[name]() for name in ("scenarios", "plain-scenarios", "single-scenarios")}
    added = replace(SCENARIOS["only-sensor"], name="mine", drift=SCENARIOS["hard"].drift)
    monkeypatch.setitem(SCENARIOS, "mine", added)
    monkeypatch.setitem(SCENARIOS, "alone", replace(SCENARIOS["only-sensor"], name="alone"))
    assert "`mine`" in tables["scenarios"]()[0]
    assert any("`alone`" in line for line in tables["single-scenarios"]())
    assert tables["plain-scenarios"]() == before["plain-scenarios"]
    assert before["scenarios"][0].count("`") == 2 * len(("randomized", "hard", "sensor-fault", "puller"))


def test_the_nomenclature_is_complete(nomenclature: Any, pages: dict[Path, Page], site: Path) -> None:
    words = {word.strip() for word in pages[site / "docs" / "nomenclature.html"].words}
    for record in (Parameters, State, Inputs, Disturbance, Puller):
        assert set(record._fields) <= words
    rows = [*nomenclature.states(), *nomenclature.inputs(), *nomenclature.parameters(), *nomenclature.derived()]
    for row in rows:
        assert row.unit, row
        assert row.meaning, row
        assert row.equations, f"{row.code}: no numbered equation of docs/physics.md holds {row.symbol}"
    assert {row.code: row.source for row in nomenclature.parameters()} == {n: q.source for n, q in describe().items()}


def test_equations_are_numbered_through(nomenclature: Any) -> None:
    found = list(nomenclature.formulas())
    assert found == [str(number) for number in range(1, len(found) + 1)]


@pytest.mark.parametrize(
    ("tex", "text", "holds"),
    [
        ("a", r"a^2 = b", True),
        ("a", r"G_{1a} + T_a + \alpha + a_0", False),
        ("T_1", r"C_1 \dot{T}_1 = T_{1,0} + T_{12}", False),
        ("h_c", r"\frac{h_c}{2 r_c}", True),
        (r"\rho_l", r"\frac{2}{\rho_l g}", True),
        (r"\rho_s", r"\rho_{sx}", False),
    ],
)
def test_a_symbol_is_found_where_it_stands_alone(
    nomenclature: Any, monkeypatch: pytest.MonkeyPatch, tex: str, text: str, holds: bool
) -> None:
    monkeypatch.setattr(nomenclature, "formulas", lambda: {"1": text})
    assert nomenclature.equations(tex) == (("1",) if holds else ())


def test_public_names_are_in_the_reference(pages: dict[Path, Page], site: Path) -> None:
    anchors = set().union(*(pages[file].anchors for file in sorted((site / "docs" / "api").glob("*.html"))))
    assert {f"cz_gym.{name}" for name in cz_gym.__all__} <= anchors
    assert {f"cz_gym.baselines.{name}" for name in baselines.__all__} <= anchors
