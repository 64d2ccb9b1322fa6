"""Imports run one way: no circle of modules or rooms, and nothing from a higher room."""

import pytest

from tests.processes import python
from tests.project.imports import FORBIDDEN, arrows, circle, imports, modules, room, within


def test_there_is_no_circle() -> None:
    found = arrows()
    assert circle({("a", "b"), ("b", "a")}) != []
    assert circle(found) == []
    assert circle({(room(one), room(other)) for one, other in found if room(one) != room(other)}) == []


@pytest.mark.parametrize("package", FORBIDDEN)
def test_nothing_is_imported_from_above(package: str) -> None:
    inner = [each for each in FORBIDDEN if each != package and within(each, package)]
    mine = {name: file for name, file in modules().items() if within(name, package)}
    for name, file in mine.items():
        if not any(within(name, each) for each in inner):
            upward = [each for each in imports(name, file) if any(within(each, other) for other in FORBIDDEN[package])]
            assert not upward, f"{name} imports {upward}"
    assert mine


@pytest.mark.parametrize(
    ("module", "absent"),
    [
        ("cz_gym", {"cz_gym.physics.young_laplace"}),
        ("cz_gym.play", {"torch", "pygame", "PIL", "onnxruntime"}),
    ],
)
def test_importing_loads_nothing_that_is_not_needed(module: str, absent: set[str]) -> None:
    code = f"import sys, {module}; assert not {absent} & set(sys.modules)"
    python("-W", "error", "-c", code)


@pytest.mark.parametrize("name", ["baselines", "agents"])
def test_no_module_has_a_second_name(name: str) -> None:
    code = f"import cz_gym.{name}\ntry: import {name}.anything\nexcept ImportError as error: print(error)"
    assert f"import cz_gym.{name}" in python("-c", code)
