"""``report.html``: the benchmark as one page that opens from disk, and fetches nothing: tables, and plotly's pictures.

Names come from agent files and are untrusted: they are escaped for HTML and for plotly.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from html import escape
from importlib.resources import files

from plotly.graph_objects import Figure
from plotly.offline import get_plotlyjs

from cz_gym.evaluation.results import Result
from cz_gym.support.units import HOUR, MM

from . import grower, tables
from .contents import contents_of
from .markdown import measured_from
from .page_pictures import crystal, pareto

BEST_NOTE = (
    "The best of each kind by mean RMSE [mm] over these scenarios, and your own. "
    "Drives and return are those on the first."
)
ANSWER_NOTE = (
    "RMSE of the true radius; the difference is learned less classical, and is shown if its 95&nbsp;% interval, on "
    "the same crystals, leaves out zero. Who moves the pull speed more can have less error: "
    "docs/controllers/bounds.md compares at equal pull steps."
)
_SLOT = re.compile(r"<!-- slot:(\w+) -->")


def page(results: Sequence[Result], command: str) -> str:
    """Return the page; the same results give the same text."""
    case, samples, shown = results[0].case, results[0].samples, contents_of(results[0].case)
    verdict = shown.verdict(results)
    config, most = case.config(), max(len(result.seeds) for result in results)
    counted = tables.deciding(results)
    best = replace(counted[0], samples=tuple(tables.best_of_each_kind(counted)))
    heads, groups = shown.overview([best, *counted[1:]])
    parts = {
        "style": _asset("page.css"),
        "plotly": get_plotlyjs(),
        "verdict": escape(verdict.sentence),
        "best": _table(heads, [(f"{name} [{kind}]", *cells) for kind, rows in groups.items() for name, *cells in rows]),
        "best_note": BEST_NOTE,
        "question": "Who holds the radius best",
        "answer_note": ANSWER_NOTE,
        "limit": f"{config.radius_limit / MM:.3g}",
        "lede": f"{tables.count(len(samples), 'controller')}, {tables.count(len(results), 'scenario')}, "
        f"up to {tables.crystals(most)} each, the same for everyone: at most {config.horizon / HOUR:.3g} h at one "
        f"action every {config.control_interval:g} s, on {case.grown_on}.",
        "scenarios": _table(verdict.heads, verdict.rows) if verdict.rows else "",
        "tables": "\n".join(_metrics(result, is_open=result is results[0]) for result in results),
        "pareto": _html(pareto(results), "pareto"),
        "crystal": _html(crystal(results), "crystal"),
        "controllers": _table(tables.WHO, tables.who(samples), "words"),
        "command": escape(command),
    }
    if case.tolerance is not None:
        parts |= _for_a_grower(results)
    return _SLOT.sub(lambda slot: parts[slot[1]], _asset("page.html"))


def _for_a_grower(results: Sequence[Result]) -> dict[str, str]:
    """The parts of the page that differ on a puller."""
    tables_of = (f"<h3>{escape(result.case.name)}</h3>{_table(*grower.outcome(result))}" for result in results)
    return {
        "verdict": escape(grower.recommendation(results)),
        "best": f"<h2>{escape(grower.title(results[0].case))}</h2>{''.join(tables_of)}",
        "best_note": escape(grower.EXPLAINED),
        "question": "What the loops bear",
        "scenarios": _table(grower.MARGINS, grower.margins(results[0].samples, results[0])),
        "answer_note": escape(grower.MARGINS_EXPLAINED),
    }


def _html(figure: Figure, name: str) -> str:
    """A picture as plotly's own HTML, with a script that waits until the page runs it."""
    margin = {"l": 60, "r": 10, "t": 90, "b": 40}
    figure.update_layout(template="plotly_white", margin=margin, hoverlabel_namelength=-1)
    config = {"displayModeBar": False, "responsive": True}
    text: str = figure.to_html(config, full_html=False, include_plotlyjs=False, div_id=name)
    return text.replace("<script>", '<script type="text/plain">')


def _metrics(result: Result, is_open: bool) -> str:
    """Every metric of a scenario, the lowest RMSE first, to unfold."""
    error, drives = contents_of(result.case).columns
    columns = (*error, *tables.comparison(result), *drives)
    ranked = sorted(result.samples, key=lambda sample: result.means[sample.name][tables.RMSE.metric].mean)
    heads = "controller", *(column.heading for column in columns)
    rows = tables.rows(replace(result, samples=tuple(ranked)), columns)
    marks = (" [bound]" * sample.contender.bound for sample in ranked)
    marked = [(f"{name}{mark}", *cells) for mark, (name, *cells) in zip(marks, rows, strict=True)]
    about = escape(f"{result.case.meaning}. {measured_from(result).replace('`', '')}")
    return (
        f"<details{' open' if is_open else ''}><summary>{escape(result.case.name)} "
        f'({tables.crystals(len(result.seeds))})</summary><p class="note">{about}</p>{_table(heads, marked)}</details>'
    )


def _table(heads: Iterable[str], rows: Iterable[Iterable[str]], kind: str = "figures") -> str:
    """A table that scrolls sideways in its own frame; what stands in brackets stands below, small."""
    lines = "\n".join(
        f"<tr>{_cell('th', name)}{''.join(_cell('td', cell) for cell in cells)}</tr>" for name, *cells in rows
    )
    return (
        f'<div class="scroll"><table class="{kind}">\n<thead><tr>{"".join(_cell("th", head) for head in heads)}</tr>'
        f"</thead>\n<tbody>\n{lines}\n</tbody></table></div>"
    )


def _cell(tag: str, text: str) -> str:
    first, _, below = text.partition(" [")
    return f"<{tag}>{escape(first)}{f'<small>[{escape(below)}</small>' if below else ''}</{tag}>"


def _asset(name: str) -> str:
    return files(__package__).joinpath("html", name).read_text("utf-8")
