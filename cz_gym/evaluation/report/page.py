"""``report.html``: the benchmark as one page that opens from disk: tables, and plotly's interactive pictures.

Everything is inside the file, plotly.js included, and its content policy forbids the browser to fetch anything else.
Names come from agent files and are untrusted: they are escaped for HTML and for plotly.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from html import escape
from importlib.resources import files

from plotly.graph_objects import Figure
from plotly.offline import get_plotlyjs

from cz_gym.evaluation.results import Result, Sample
from cz_gym.units import HOUR

from . import tables
from .canvas import styles_of
from .markdown import measured_from
from .page_pictures import crystal, pareto

_SLOT = re.compile(r"<!-- slot:(\w+) -->")


def page(results: Sequence[Result], command: str) -> str:
    """Return the page; the same results give the same text."""
    row, styles = results[0].row, styles_of(results[0].samples)
    config, most = row.config(), max(len(result.seeds) for result in results)
    parts = {
        "style": _asset("page.css"),
        "plotly": get_plotlyjs(),
        "verdict": escape(tables.headline(results)),
        "lede": f"{tables.count(len(results[0].samples), 'controller')}, {tables.count(len(results), 'scenario')}, "
        f"up to {tables.crystals(most)} each, the same for everyone: {config.horizon / HOUR:g} h at one action every "
        f"{config.control_interval:g} s, on {row.grown_on}.",
        "tables": "\n".join(_table(result, is_open=result is results[0]) for result in results),
        "pareto": _html(pareto(results, styles), "pareto"),
        "crystal": _html(crystal(results, styles), "crystal"),
        "controllers": "\n".join(
            "<tr>"
            + _each("td", (each.name, each.observation, each.meaning, ", ".join(map(str, each.training_seeds))))
            + "</tr>"
            for each in (sample.contender for sample in results[0].samples)
        ),
        "command": escape(command),
    }
    return _SLOT.sub(lambda slot: parts[slot[1]], _asset("page.html"))


def _html(figure: Figure, name: str) -> str:
    margin = {"l": 60, "r": 10, "t": 90, "b": 40}
    figure.update_layout(template="plotly_white", margin=margin, hoverlabel_namelength=-1)
    config = {"displayModeBar": False, "responsive": True}
    text: str = figure.to_html(config, full_html=False, include_plotlyjs=False, div_id=name)
    return text


def _table(result: Result, is_open: bool) -> str:
    """Every metric of a scenario, the lowest RMSE first, to unfold."""
    columns = (*tables.ERROR, *tables.comparison(result), *tables.DRIVES)
    heads = _each("th", ("controller", *(column.heading for column in columns)))
    ranked = sorted(result.samples, key=lambda sample: result.means[sample.name][tables.RMSE.metric].mean)
    lines = "\n".join(
        f"<tr>{_name(sample, result)}{''.join(_cell(result, sample.name, column) for column in columns)}</tr>"
        for sample in ranked
    )
    about = escape(f"{result.row.meaning}. {measured_from(result).replace('`', '')}")
    return (
        f"<details{' open' if is_open else ''}><summary>{escape(result.row.name)} "
        f'({tables.crystals(len(result.seeds))})</summary><p class="note">{about}</p>'
        f'<div class="scroll"><table class="metrics">\n<thead><tr>{heads}</tr></thead>\n'
        f"<tbody>\n{lines}\n</tbody></table></div></details>"
    )


def _name(sample: Sample, result: Result) -> str:
    bound = "<small>bound: knows what no sensor shows</small>" if sample.contender.bound else ""
    return f"<th>{escape(tables.label(sample, result))}{bound}</th>"


def _cell(result: Result, name: str, column: tables.Column) -> str:
    mean, _, interval = column.text(column.estimate(result, name)).partition(" ")
    return f"<td>{mean}<small>{interval}</small></td>"


def _each(tag: str, texts: Iterable[str]) -> str:
    return "".join(f"<{tag}>{escape(text)}</{tag}>" for text in texts)


def _asset(name: str) -> str:
    return files(__package__).joinpath("html", name).read_text("utf-8")
