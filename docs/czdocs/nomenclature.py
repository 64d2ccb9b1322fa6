r"""The nomenclature: symbols follow from the code's names, equations from where the physics page uses them."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from sphinx.pycode import ModuleAnalyzer

from cz_gym import Parameters, Puller, State
from cz_gym.body.signals import INFO_ROWS
from cz_gym.physics.parameters import describe
from cz_gym.physics.plant import Disturbance
from cz_gym.process import Inputs

PHYSICS = Path(__file__).parents[1] / "physics.md"
GREEK = frozenset({"alpha", "kappa", "lam", "lambda", "phi", "rho", "sigma", "theta", "Phi"})
UNLIKE = {
    "eps": r"\varepsilon",
    "emission": r"\varepsilon \, \sigma_{SB}",
    "v_p_mean": r"\bar{v}_p",
    "lam": r"\lambda",
    "X_b": r"\xi_b",
    "layer": r"k_l R",
    "ring_bias": r"b",
    "melt": r"m",
    "ring_offset": r"\delta_{br}",
    "rho_dH": r"\rho_s \Delta H",
    "sin_alpha_0": r"\sin\alpha_0",
    "cos_alpha_0": r"\cos\alpha_0",
}
"""Symbols that do not follow from their names."""
UNIT = re.compile(r"\s*\[([^\]\[]*)\]")
FORMULA = re.compile(r"\$\$((?:(?!\$\$).)*)\\tag\{(\d+)\}\s*\$\$", re.DOTALL)
WITHOUT_SYMBOL = frozenset({"action_clipped", "cost", "r_br_measured"})


class Row(NamedTuple):
    """A line of the nomenclature."""

    symbol: str
    code: str
    unit: str
    meaning: str
    equations: tuple[str, ...]
    value: str = ""
    source: str = ""


def symbol(name: str) -> str:
    """The LaTeX of a name: ``rho_l`` is rho with subscript l, ``dT_0`` is Delta T_0, ``T_1_0`` has subscripts 1, 0."""
    if name in UNLIKE:
        return UNLIKE[name]
    letter, *below = name.split("_")
    delta = r"\Delta " if re.fullmatch(r"d[A-Z]", letter) else ""
    letter = letter[1:] if delta else letter
    letter = f"\\{letter}" if letter in GREEK else letter
    under = ",".join(below)
    return delta + letter + (f"_{{{under}}}" if len(under) > 1 else f"_{under}" if under else "")


def formulas() -> dict[str, str]:
    """The physics page's numbered formulas."""
    return {number: text for text, number in FORMULA.findall(PHYSICS.read_text())}


def equations(tex: str) -> tuple[str, ...]:
    """Numbers of the physics page's formulas that hold a symbol."""
    before = "" if tex.startswith("\\") else r"(?<![A-Za-z0-9_\\,])(?<!_\{)"
    after = "" if tex.endswith("}") else r"(?![A-Za-z0-9{])"
    if "_" not in tex:
        after += r"(?!_)"
    pattern = re.compile(before + re.escape(tex) + after)
    return tuple(number for number, text in formulas().items() if pattern.search(text))


def _documented(cls: type, without: tuple[str, ...] = ()) -> list[Row]:
    """The fields of a class with the text below each, whose first brackets hold the unit."""
    rows = []
    for (owner, name), lines in ModuleAnalyzer.for_module(cls.__module__).find_attr_docs().items():
        if owner == cls.__name__ and name not in without:
            text, unit = " ".join(lines).strip(), UNIT.search(" ".join(lines))
            rows.append(_row(name, unit[1] if unit else "", UNIT.sub("", text, count=1).rstrip(".")))
    return rows


def _row(name: str, unit: str, meaning: str, value: str = "", source: str = "") -> Row:
    return Row(symbol(name), name, unit, meaning, equations(symbol(name)), value, source)


def seen() -> list[Row]:
    """Rows of ``info`` that have a symbol and are neither states nor inputs."""
    known = {*State._fields, *Inputs._fields, *WITHOUT_SYMBOL}
    shown = (row for row in INFO_ROWS if row.name not in known and not row.name.startswith("term_"))
    return [_row(row.name, row.unit, row.meaning) for row in shown]


def parameters() -> list[Row]:
    """Given numbers of a puller and its material."""
    values = Parameters()._asdict()
    return [_row(name, q.unit, q.meaning, f"{values[name]:.6g}", q.source) for name, q in describe().items()]


ROWS: dict[str, Callable[[], list[Row]]] = {
    "states": lambda: _documented(State),
    "inputs": lambda: _documented(Inputs) + _documented(Disturbance),
    "seen": seen,
    "parameters": parameters,
    "derived": lambda: _documented(Puller, Parameters._fields),
}
"""The parts of the nomenclature."""
