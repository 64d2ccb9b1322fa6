"""``cz-gym list``: the names that commands take, each with the line that its registry has on it."""

import argparse
from collections.abc import Callable, Iterator, Sequence
from textwrap import wrap

from cz_gym.episodes.scenarios import ALL, SCENARIOS
from cz_gym.evaluation import protocol
from cz_gym.puller.file import FOLDER
from cz_gym.support.command_line import OneLineParser

from .registry import KNOWN

WIDTH = 80
"""Width of the lines [characters]."""
Section = tuple[str, list[tuple[str, str]]]
"""Heading, and names with a line each."""


def controllers() -> Iterator[Section]:
    """Classical controllers of each environment."""
    for environment, known in KNOWN.items():
        yield f"controllers of {environment}", [(each.name, each.meaning) for each in known]


def scenarios() -> Iterator[Section]:
    """Scenarios of crystals, and those that the benchmark alone knows."""
    told = {each.name: each.meaning for each in protocol.CASES}
    yield (
        "scenarios",
        [(name, told[name]) for name in told if name in SCENARIOS] + [("all", f"in training: {ALL.name}")],
    )
    yield "scenarios of the benchmark alone", [(name, told[name]) for name in told if name not in SCENARIOS]


def stages() -> Iterator[Section]:
    """Parts of a whole crystal."""
    grown = [case for case in protocol.CRYSTAL_CASES if case.scenario == "randomized"]
    others = dict.fromkeys(f"-{case.scenario}" for case in protocol.CRYSTAL_CASES if case.scenario != "randomized")
    heading = f"stages of CzCrystal-v0; scenarios of its benchmark, with {', '.join(others)} too"
    yield heading, [(case.name, case.meaning) for case in grown]


def pullers() -> Iterator[Section]:
    """Shipped pullers, each with the first sentence of its file."""
    files = {path.stem: path.read_text("utf-8").splitlines() for path in sorted(FOLDER.glob("*.toml"))}
    heads = {name: " ".join(line.strip("# ") for line in lines if line[:1] == "#") for name, lines in files.items()}
    yield "pullers", [(name, head.partition(". ")[0]) for name, head in heads.items()]


def agents() -> Iterator[Section]:
    """Shipped agents of each environment."""
    from cz_gym.agents import shipped_names, shipped_seeds  # onnx is in an extra
    from cz_gym.agents.contract import read_agent

    for environment in KNOWN:
        lines = []
        for name in shipped_names(environment):
            seeds = shipped_seeds(name)
            contract = read_agent(seeds[0])[0]
            source = protocol.GROUPS.get(contract.learned_from, contract.learned_from)
            trained_on = "all" if contract.scenario == ALL.name else contract.scenario
            lines.append((name, f"{source}; {len(seeds)} training seeds, on {trained_on}"))
        yield f"agents of {environment}", lines


KINDS: dict[str, Callable[[], Iterator[Section]]] = {
    each.__name__: each for each in (controllers, scenarios, stages, pullers, agents)
}
"""Lists by the word that asks for them."""


def text_of(section: Section) -> str:
    """Write a section in lines of at most :data:`WIDTH` characters."""
    heading, lines = section
    column = max(len(name) for name, _ in lines) + 4
    texts = [(f"{heading}:", ""), *((f"  {name:<{column - 2}}{about}", " " * column) for name, about in lines)]
    wrapped = (wrap(text, WIDTH, subsequent_indent=indent, break_on_hyphens=False) for text, indent in texts)
    return "\n".join(line for each in wrapped for line in each)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser("cz-gym list", "List the names that commands take, with a line on each.")
    add, about = parser.add_argument, f"{', '.join(KINDS)} (all of them)"
    add("kinds", nargs="*", choices=[*KINDS, []], default=[], metavar="KIND", help=about)
    return parser.run(_main, arguments, "benchmark")


def _main(given: argparse.Namespace) -> None:
    for kind in given.kinds or KINDS:
        for section in KINDS[kind]():
            print(text_of(section), end="\n\n")
