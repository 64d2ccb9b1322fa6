"""Imports run one way: no circle of modules or rooms, and nothing from a higher room.

A room is a package, or a module that stands beside packages (``cz_gym.env``, ``cz_gym.baselines.policy``, ``train``).
"""

import ast
from graphlib import CycleError, TopologicalSorter

import pytest

from tests.processes import ROOT, python

PROGRAMS = ("benchmark", "train", "cz_gym_command")
ABOVE = ("studies", "examples", "tests", *PROGRAMS)
FORBIDDEN = {
    "cz_gym": ("cz_gym.baselines", "cz_gym.agents", "cz_gym.tools", *ABOVE),
    "cz_gym.baselines": ("cz_gym.agents", "cz_gym.tools", *ABOVE),
    "cz_gym.agents": ("cz_gym.baselines", "cz_gym.tools", *ABOVE),
    "cz_gym.tools": ABOVE,
    "studies": ("tests", *PROGRAMS),
}
"""Packages, and what nothing in each may import."""
BESIDE = ("agents", "baselines")
"""Folders beside ``cz_gym`` that are packages in it."""
Arrows = set[tuple[str, str]]
"""Pairs of which the first imports from the second."""


def modules():
    """Every module by its one name."""
    found = {name: ROOT / f"{name}.py" for name in PROGRAMS}
    for top in ("cz_gym", *BESIDE, "studies"):
        for file in (ROOT / top).rglob("*.py"):
            name = ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
            found[f"cz_gym.{name}" if top in BESIDE else name] = file
    return dict(sorted(found.items()))


def imports(name, file):
    """Dotted names that a module imports: modules, or names in them."""
    package = name if file.name == "__init__.py" else name.rpartition(".")[0]
    for node in ast.walk(ast.parse(file.read_bytes())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            yield from (f"{base}.{alias.name}" for alias in node.names)


def within(name, package):
    """Whether a dotted name is a package or lies in it."""
    return name == package or name.startswith(f"{package}.")


def arrows():
    """Arrows between modules."""
    known = modules()
    targets = ((name, each, each.rpartition(".")[0]) for name, file in known.items() for each in imports(name, file))
    found = {(name, each if each in known else holder) for name, each, holder in targets}
    return {(name, target) for name, target in found if target in known and target != name}


def room(name):
    """The room of a module: its package, or itself where packages stand beside it."""
    package = name.rpartition(".")[0]
    beside = any(within(name, f"cz_gym.{each}") for each in BESIDE)
    folder = ROOT / (name.removeprefix("cz_gym.") if beside else name).replace(".", "/")
    several = any((each / "__init__.py").exists() for each in folder.parent.iterdir())
    return name if folder.is_dir() or several or not package else package


def check_no_circle(pairs):
    """Raise CycleError, which names the first circle."""
    graph = {}
    for one, other in pairs:
        graph.setdefault(one, set()).add(other)
    TopologicalSorter(graph).prepare()


def test_packages_do_not_import_in_a_circle():
    found = arrows()
    with pytest.raises(CycleError):
        check_no_circle({("a", "b"), ("b", "a")})
    check_no_circle(found)
    check_no_circle({(room(one), room(other)) for one, other in found if room(one) != room(other)})


@pytest.mark.parametrize("package", FORBIDDEN)
def test_nothing_is_imported_from_above(package):
    inner = [each for each in FORBIDDEN if each != package and within(each, package)]
    mine = {name: file for name, file in modules().items() if within(name, package) and name != "cz_gym.__main__"}
    for name, file in mine.items():
        if not any(within(name, each) for each in inner):
            upward = [each for each in imports(name, file) if any(within(each, other) for other in FORBIDDEN[package])]
            assert not upward, f"{name} imports {upward}"
    assert mine


def test_importing_loads_nothing_that_is_not_needed_and_no_module_has_a_second_name():
    loads = "import sys, {}; assert not {} & set(sys.modules)"
    code = [loads.format("cz_gym", {"cz_gym.physics.young_laplace"})]
    code += [loads.format("cz_gym.tools.play", {"torch", "pygame", "PIL", "onnxruntime"})]
    for name in ("baselines", "agents"):
        code += [f"import cz_gym.{name}", f"try: import {name}.anything", "except ImportError as error: print(error)"]
    told = python("-W", "error", "-c", "\n".join(code))
    assert "import cz_gym.baselines" in told
    assert "import cz_gym.agents" in told


def test_only_agents_import_torch():
    """``cz_gym.sb3`` adapts stable-baselines3, which imports it by itself."""
    named = {name: {each.partition(".")[0] for each in imports(name, file)} for name, file in modules().items()}
    below = {name for name in named if within(name, "cz_gym") and not within(name, "cz_gym.agents")}
    assert [name for name in below if "torch" in named[name]] == []
    assert [name for name in below if "stable_baselines3" in named[name]] == ["cz_gym.sb3"]
