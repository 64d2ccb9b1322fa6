"""The import graph of the packages: ``python -m tests.project.imports`` prints rooms, imports between them and circles.

A room is a package, or a module that stands beside packages (``cz_gym.env``, ``cz_gym.baselines.policy``, ``train``).
"""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from itertools import pairwise
from pathlib import Path

ROOT = Path(__file__).parents[2]
FOLDERS = {"cz_gym": "cz_gym", "baselines": "cz_gym.baselines", "agents": "cz_gym.agents", "studies": "studies"}
"""Folders of the checkout and the packages in them."""
PROGRAMS = ("benchmark", "train")
FORBIDDEN = {
    "cz_gym": ("cz_gym.baselines", "cz_gym.agents", "studies", "examples", "tests", *PROGRAMS),
    "cz_gym.baselines": ("cz_gym.agents", "studies", "examples", "tests", *PROGRAMS),
    "cz_gym.agents": ("cz_gym.baselines", "studies", "examples", "tests", *PROGRAMS),
    "studies": ("examples", "tests", *PROGRAMS),
}
"""What nothing in a package may import."""


def modules() -> dict[str, Path]:
    """Every module by its one name."""
    found = {name: ROOT / f"{name}.py" for name in PROGRAMS}
    for folder, package in FOLDERS.items():
        for file in sorted((ROOT / folder).rglob("*.py")):
            parts = file.relative_to(ROOT / folder).with_suffix("").parts
            if folder != "cz_gym" or parts[0] not in FOLDERS:
                found[".".join((package, *parts)).removesuffix(".__init__")] = file
    return found


def imports(name: str, file: Path) -> Iterator[str]:
    """Dotted names that a module imports: modules, or names in them."""
    package = name if file.name == "__init__.py" else name.rpartition(".")[0]
    for node in ast.walk(ast.parse(file.read_bytes())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            yield from (f"{base}.{alias.name}" for alias in node.names)


def within(name: str, package: str) -> bool:
    """Whether a dotted name is a package or lies in it."""
    return name == package or name.startswith(f"{package}.")


def arrows() -> Counter[tuple[str, str]]:
    """How often each module imports from each other one."""
    known = modules()
    found: Counter[tuple[str, str]] = Counter()
    for name, file in known.items():
        for imported in imports(name, file):
            target = imported if imported in known else imported.rpartition(".")[0]
            if target in known and target != name:
                found[name, target] += 1
    return found


def room(name: str) -> str:
    """The room of a module: its package, or itself where packages stand beside it."""
    file, package = modules()[name], name.rpartition(".")[0]
    beside = file.parent if file.name != "__init__.py" else file.parent.parent
    several = any(folder.is_dir() and (folder / "__init__.py").exists() for folder in beside.iterdir())
    return name if file.name == "__init__.py" or several or not package else package


def circles(graph: dict[str, set[str]]) -> list[str]:
    """The first circle found, as a list of names; empty if there is none."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def graph_of(pairs: Counter[tuple[str, str]]) -> dict[str, set[str]]:
    """Who imports whom."""
    graph: dict[str, set[str]] = {}
    for one, other in pairs:
        graph.setdefault(one, set()).add(other)
    return graph


def between_rooms() -> Counter[tuple[str, str]]:
    """How often rooms import from each other."""
    rooms = {name: room(name) for name in modules()}
    found: Counter[tuple[str, str]] = Counter()
    for (one, other), times in arrows().items():
        if rooms[one] != rooms[other]:
            found[rooms[one], rooms[other]] += times
    return found


def main() -> None:
    """Print what there is."""
    pairs = between_rooms()
    rooms = {room(name) for name in modules()}
    circle = circles(graph_of(pairs))
    for folder, package in FOLDERS.items():
        others = [each for each in FOLDERS.values() if each != package and within(each, package)]
        mine = [each for each in rooms if within(each, package) and not any(within(each, other) for other in others)]
        inside = sum(one in mine and other in mine for one, other in pairs)
        print(f"{folder:10s} {len(mine):3d} rooms, {inside:3d} arrows between them")
    print(f"all        {len(rooms):3d} rooms, {len(pairs):3d} arrows, {sum(pairs.values())} imports")
    print("circles    " + (" ".join(f"{one} -> {other};" for one, other in pairwise(circle)) or "none"))


if __name__ == "__main__":
    main()
