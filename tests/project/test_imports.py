"""Imports run one way: down the order of rooms, and in no circle of modules.

A room is a package, or a module that stands beside packages (``cz_gym.env``, ``train``).
"""

import ast
from graphlib import CycleError, TopologicalSorter

import pytest

from tests.conftest import ROOT, python

ROOMS = (
    *("cz_gym.support", "cz_gym.jit", "cz_gym.process", "cz_gym.physics", "cz_gym.puller", "cz_gym.episodes"),
    *("cz_gym.body", "cz_gym.crystal", "cz_gym.camera", "cz_gym.spaces", "cz_gym.config", "cz_gym.engine"),
    *("cz_gym.rendering", "cz_gym.env", "cz_gym", "cz_gym.sb3", "cz_gym.evaluation"),
    *("cz_gym.baselines", "cz_gym.agents", "cz_gym.tools", "studies", "cz_gym.examples"),
)
PROGRAMS = ("cz_gym_command", "benchmark", "train", "cz_gym.__main__")
"""Doors of the commands, which nothing imports but the first, by the others."""
BESIDE = ("agents", "baselines", "examples")
"""Folders beside ``cz_gym`` that are packages in it."""
Arrows = set[tuple[str, str]]
"""Pairs of which the first imports from the second."""


def modules():
    """Every module by its one name."""
    found = {name: ROOT / f"{name}.py" for name in PROGRAMS[:3]}
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
    """The room of a module: the longest name in ``ROOMS`` that holds it."""
    return max((each for each in ROOMS if within(name, each)), key=len)


def check_no_circle(pairs):
    """Raise CycleError, which names the first circle."""
    graph = {}
    for one, other in pairs:
        graph.setdefault(one, set()).add(other)
    TopologicalSorter(graph).prepare()


def test_imports_run_down_the_order_of_rooms_and_in_no_circle():
    found = arrows()
    with pytest.raises(CycleError):
        check_no_circle({("a", "b"), ("b", "a")})
    check_no_circle(found)
    inner = {(one, other) for one, other in found if one not in PROGRAMS}
    assert {other for one, other in found - inner} == {"cz_gym_command"}
    assert not {other for _, other in inner} & {*PROGRAMS}
    assert [pair for pair in inner if ROOMS.index(room(pair[0])) < ROOMS.index(room(pair[1]))] == []
    assert {room(one) for one, _ in inner} == {*ROOMS}
    assert not any(within(each, "tests") for name, file in modules().items() for each in imports(name, file))
    pairs = {(room(one), room(other)) for one, other in inner}
    assert not {("cz_gym.agents", "cz_gym.baselines"), ("cz_gym.evaluation", "cz_gym.sb3")} & pairs
    assert {other for one, other in pairs if one == "cz_gym.puller"} <= {*ROOMS[:5]}


def test_tools_do_not_import_each_other_in_a_circle():
    tools = {(one, other) for one, other in arrows() if within(one, "cz_gym.tools") and within(other, "cz_gym.tools")}
    rooms = {tuple(".".join(name.split(".")[:3]) for name in pair) for pair in tools}
    check_no_circle({(one, other) for one, other in rooms if one != other})


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
    below = {name for name in below if not within(name, "cz_gym.examples")}
    assert [name for name in below if "torch" in named[name]] == []
    assert [name for name in below if "stable_baselines3" in named[name]] == ["cz_gym.sb3"]
