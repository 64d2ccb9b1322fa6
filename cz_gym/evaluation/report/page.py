"""``report.html``: the benchmark as one page that opens from disk: table, pictures, and the first episodes' signals.

Everything is inside the file, plotly.js included, and its content policy forbids the browser to fetch anything else.
Names come from agent files and are untrusted: they travel as JSON that no HTML can end, and ``html/*.js`` writes them
as text alone.
"""

from __future__ import annotations

import json
import re
from importlib.resources import files
from typing import Any

from plotly.offline import get_plotlyjs

from cz_gym.evaluation.metrics import TOLERANCE
from cz_gym.evaluation.results import REFERENCE, Benchmark, Controller, ScenarioResult
from cz_gym.units import HOUR, MINUTE, MM, MM_PER_MIN

from .canvas import styles
from .page_signals import CURVES, SHARED, episodes
from .page_tables import DISTRIBUTIONS, columns, distributions, rows
from .verdict import headline

SCRIPTS = ("data.js", "look.js", "table.js", "pictures.js", "viewer.js", "main.js")
"""The page's own code, in the order of use."""
SYMBOLS = {
    "o": "circle", "s": "square", "D": "diamond", "^": "triangle-up", "v": "triangle-down", "P": "cross", "*": "star",
    "X": "x", "p": "pentagon", "h": "hexagon", "<": "triangle-left", ">": "triangle-right",
}  # fmt: skip
"""matplotlib's markers by plotly's names."""
DASHES = ("solid", "dash", "dot")
"""Line styles: the next one where the colours begin again."""
_SLOT = re.compile(r"<!-- slot:(\w+) -->")


def page(benchmark: Benchmark) -> str:
    """The page; the same results give the same text."""
    parts = {
        "style": _asset("page.css"),
        "plotly": get_plotlyjs(),
        "scripts": "\n".join(_asset(name) for name in SCRIPTS),
        "facts": embedded(facts(benchmark)),
        "episodes": embedded([episodes(scenario) for scenario in benchmark.scenarios]),
    }
    return _SLOT.sub(lambda slot: parts[slot[1]], _asset("page.html"))


def embedded(value: Any) -> str:
    """A value as JSON that stays JSON inside a script element: ASCII, and nothing that HTML could read as markup."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def facts(benchmark: Benchmark) -> dict[str, Any]:
    """Everything the page shows but the episodes' signals."""
    config = benchmark.scenarios[0].row.config()
    return {
        "verdict": headline(benchmark),
        "command": benchmark.command,
        "reference": REFERENCE,
        "interval_s": config.control_interval,
        "horizon_min": config.horizon / MINUTE,
        "horizon_h": config.horizon / HOUR,
        "tolerance_mm": TOLERANCE / MM,
        "v_0_mm_per_min": config.parameters.v_0 / MM_PER_MIN,
        "controllers": _controllers(benchmark.controllers),
        "columns": columns(benchmark),
        "distributions": [column.heading for column in DISTRIBUTIONS],
        "curves": [[curve.key, curve.unit, curve.resolution] for curve in CURVES],
        "shared": [[curve.key, curve.unit, curve.resolution] for curve in SHARED],
        "scenarios": [_scenario(benchmark, scenario) for scenario in benchmark.scenarios],
    }


def _controllers(controllers: tuple[Controller, ...]) -> list[dict[str, Any]]:
    ranked = sorted(controllers, key=lambda controller: not controller.learned)
    looks = styles([controller.name for controller in ranked])
    used: list[str] = []
    dashes = {}
    for name, look in looks.items():
        dashes[name] = DASHES[used.count(look.colour) % len(DASHES)]
        used.append(look.colour)
    return [
        {
            "name": controller.name,
            "meaning": controller.meaning,
            "reads": controller.observation,
            "training_seeds": list(controller.training_seeds),
            "bound": controller.bound,
            "colour": looks[controller.name].colour,
            "symbol": SYMBOLS[looks[controller.name].marker],
            "dash": dashes[controller.name],
        }
        for controller in controllers
    ]


def _scenario(benchmark: Benchmark, scenario: ScenarioResult) -> dict[str, Any]:
    return {
        "name": scenario.row.name,
        "meaning": scenario.row.meaning,
        "seeds": list(scenario.seeds),
        "rivals": sorted({verdict.rival for verdict in scenario.verdicts}),
        "rows": rows(benchmark, scenario),
        "distributions": distributions(scenario),
    }


def _asset(name: str) -> str:
    return files(__package__).joinpath("html", name).read_text("utf-8")
