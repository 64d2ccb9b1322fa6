"""``report.html``: the benchmark as one page that opens from disk: table, pictures, and the first episodes' signals.

Everything is inside the file, plotly.js included, and its content policy forbids the browser to fetch anything else.
Names come from agent files and are untrusted: they are escaped for HTML, for plotly, and as JSON inside a script.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from html import escape
from importlib.resources import files
from typing import Any

from plotly.graph_objects import Figure
from plotly.offline import get_plotlyjs

from cz_gym.evaluation.results import Benchmark, Outcome, ScenarioResult
from cz_gym.units import HOUR, MINUTE

from . import tables
from .canvas import styles_of
from .markdown import measured_from
from .page_figures import errors, pareto
from .page_signals import OWN, PANELS, SHARED, crystals, frame
from .verdict import headline

_SLOT = re.compile(r"<!-- slot:(\w+) -->")


def page(benchmark: Benchmark) -> str:
    """The page; the same results give the same text."""
    config, scenarios = benchmark.scenarios[0].row.config(), benchmark.scenarios
    most = max(len(scenario.seeds) for scenario in scenarios)
    parts = {
        "style": _asset("page.css"),
        "plotly": get_plotlyjs(),
        "script": _asset("page.js"),
        "data": embedded(_data(benchmark)),
        "verdict": escape(headline(benchmark)),
        "lede": f"{tables.count(len(benchmark.controllers), 'controller')}, "
        f"{tables.count(len(scenarios), 'scenario')}, up to {tables.crystals(most)} each, the same for everyone: "
        f"{config.horizon / HOUR:g} h at one action every {config.control_interval:g} s.",
        "scenarios": _each("option", (scenario.row.name for scenario in scenarios)),
        "tables": "\n".join(_table(scenario) for scenario in scenarios),
        "controllers": "\n".join(
            "<tr>"
            + _each("td", (each.name, each.observation, each.meaning, ", ".join(map(str, each.training_seeds))))
            + "</tr>"
            for each in benchmark.controllers
        ),
        "resolutions": ", ".join(f"{panel.title} {panel.resolution:g} {panel.unit}" for panel in PANELS),
        "command": escape(benchmark.command),
    }
    return _SLOT.sub(lambda slot: parts[slot[1]], _asset("page.html"))


def _data(benchmark: Benchmark) -> dict[str, Any]:
    """What the page's script draws."""
    config, styles = benchmark.scenarios[0].row.config(), styles_of(benchmark.controllers)
    best = min(benchmark.scenarios[0].verdicts, key=lambda verdict: verdict.difference.mean, default=None)
    drawn = [best.rival, best.agent] if best else []
    return {
        "minutes": config.control_interval / MINUTE,
        "resolutions": [[PANELS[panel].resolution for panel, _ in lines] for lines in (OWN, SHARED)],
        "frame": _figure(frame(benchmark.controllers, drawn, styles, config.horizon)),
        "scenarios": [
            {"pictures": [_figure(draw(each, styles)) for draw in (pareto, errors)], "crystals": crystals(each)}
            for each in benchmark.scenarios
        ],
    }


def _figure(figure: Figure) -> Any:
    margin = {"l": 60, "r": 10, "t": 50, "b": 40}
    return json.loads(figure.update_layout(template="plotly_white", margin=margin, hoverlabel_namelength=-1).to_json())


def embedded(value: Any) -> str:
    """A value as JSON that stays JSON inside a script element: ASCII, and nothing that HTML could read as markup."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _table(scenario: ScenarioResult) -> str:
    """Every metric of a scenario, the lowest RMSE first."""
    columns = (*tables.ERROR, *tables.comparison(scenario), *tables.DRIVES)
    heads = _each("th", ("controller", *(column.heading for column in columns)))
    ranked = sorted(scenario.outcomes, key=lambda outcome: outcome.means[tables.RMSE.metric].mean)
    lines = "\n".join(
        f"<tr>{_name(outcome, scenario)}{''.join(_cell(outcome, column) for column in columns)}</tr>"
        for outcome in ranked
    )
    row, count = scenario.row, tables.crystals(len(scenario.seeds))
    about = escape(f"{row.name}: {row.meaning}. {count}. {measured_from(scenario).replace('`', '')}")
    return (
        f'<div class="scenario"><p class="note">{about}</p><div class="scroll"><table class="metrics">\n'
        f"<thead><tr>{heads}</tr></thead>\n<tbody>\n{lines}\n</tbody></table></div></div>"
    )


def _name(outcome: Outcome, scenario: ScenarioResult) -> str:
    name, who = escape(tables.label(outcome, scenario)), outcome.controller
    bound = "<small>bound: knows what no sensor shows</small>" if who.bound else ""
    return f'<th data-value="{name}" title="{escape(who.meaning)}">{name}{bound}</th>'


def _cell(outcome: Outcome, column: tables.Column) -> str:
    estimate = column.estimate(outcome)
    mean, _, interval = column.text(estimate).partition(" ")
    return f'<td data-value="{estimate.mean if estimate else ""}">{mean}<small>{interval}</small></td>'


def _each(tag: str, texts: Iterable[str]) -> str:
    return "".join(f"<{tag}>{escape(text)}</{tag}>" for text in texts)


def _asset(name: str) -> str:
    return files(__package__).joinpath("html", name).read_text("utf-8")
