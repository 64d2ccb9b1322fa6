"""Plotly's pictures, one scenario shown at a time: error against pull activity, and signals of its first crystal."""

import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib.resources import files
from typing import Any

import numpy as np
import numpy.typing as npt
from plotly import graph_objects as go
from plotly.graph_objects import Figure
from plotly.offline import get_plotlyjs
from plotly.subplots import make_subplots

from cz_gym.baselines.margins import EXPLAINED as BEARS
from cz_gym.env import CzEnv
from cz_gym.evaluation.plots import COLUMNS, GREY, INK
from cz_gym.evaluation.protocol import Case
from cz_gym.evaluation.rollout import Floats
from cz_gym.support.units import HOUR, MINUTE, MM
from cz_gym.tools.episodes import Benchmark
from cz_gym.tools.report.task_records import Panel, task_of

from . import markdown, tables, vector
from .figures import lost
from .markdown import measured_from
from .tables import RMSE, chosen, looks_of

LONGEST = 32
"""Longest name that plots have room for [characters]."""


def plain(name: str) -> str:
    """Return a name as plotly may draw it: its own markup switched off, one line, not too long."""
    short = name if len(name) <= LONGEST else f"{name[: LONGEST - 1]}…"
    return escape("".join(letter if letter.isprintable() else " " for letter in short), quote=False)


def add_menu(figure: go.Figure, cases: Sequence[Case], layouts: Sequence[Mapping[str, Any]] = ()) -> None:
    """Add a menu that shows the traces of one scenario, with its layout; a trace's meta is its scenario's number."""
    buttons = []
    for number, case in enumerate(cases):
        arguments: list[Any] = [{"visible": [trace.meta == number for trace in figure.data]}]
        arguments += [dict(layouts[number])] if layouts else []
        buttons.append({"label": plain(case.name), "method": "update", "args": arguments})
    figure.for_each_trace(lambda trace: trace.update(visible=trace.meta == 0))
    menu = {"buttons": buttons, "x": 0, "xanchor": "left", "y": 1, "yanchor": "bottom", "pad": {"b": 28}}
    figure.update_layout(updatemenus=[menu] if len(cases) > 1 else [], **(layouts[0] if layouts else {}))


POINT = 45.0
"""Time over which a point is the mean [s]."""
OUTLIERS = 0.001
"""Share of the values at either end that may lie outside a panel's range [-]."""


OWN = ("true", "camera")
"""Lines that are drawn for each controller."""


def crystal(benchmark: Benchmark) -> go.Figure:
    """Draw the first crystal of each scenario, one scenario at a time, under the controllers of :func:`chosen`."""
    task, config = task_of(benchmark.cases[0]), benchmark.cases[0].config()
    panels = task.panels
    titles = [f"{panel.title} [{panel.unit}]" for panel in panels]
    figure = make_subplots(len(panels), 1, shared_xaxes=True, vertical_spacing=0.02, subplot_titles=titles)
    layouts = [_draw(figure, number, benchmark, case) for number, case in enumerate(benchmark.cases)]
    for row, panel in enumerate(panels, 1):
        for level in panel.levels:
            line = {"color": GREY, "width": 1, "dash": "dot"}
            figure.add_hline(level, row=row, col=1, line=line, layer="below")
    if not task.by_length:
        figure.update_xaxes(range=[0.0, config.horizon / MINUTE])
    figure.update_xaxes(hoverformat=".2f", nticks=10)
    figure.update_xaxes(title="length [mm]" if task.by_length else "time [min]", row=len(panels), col=1)
    legend = {"orientation": "h", "y": -0.04, "yanchor": "top", "groupclick": "togglegroup"}
    figure.update_layout(legend=legend, height=150 * len(panels), hovermode="x")
    add_menu(figure, benchmark.cases, layouts)
    return figure


def _draw(figure: go.Figure, scenario: int, benchmark: Benchmark, case: Case) -> dict[str, Any]:
    """Add the lines of a scenario and return the ranges of its panels: those of the crystals that were not lost."""
    task, names = task_of(case), [each.name for each in chosen(benchmark, case, COLUMNS)]
    whole = [name for name in names if not lost(benchmark, case, name)] or names
    signals = {name: benchmark.signals[case.name, name] for name in names}
    longest = max(signals.values(), key=lambda each: len(each.r_c))
    bias = ring_bias(case, benchmark.seeds(case)[0])
    step = max(round(POINT / case.control_interval), 1)
    minutes = step * case.control_interval / MINUTE
    layout: dict[str, Any] = {}
    for number, panel in enumerate(task.panels):
        ends = list(panel.levels)
        for line, name, own in _lines(panel, names):
            logged = signals[name] if own else longest
            values = _points(panel.lines[line](logged, bias) / panel.scale, step)
            look = {"name": line, "legendgroup": line, **_DRAWN["shared"]}
            if own:
                look = _own_look(benchmark, case, name, line, number)
            if task.by_length:
                look["x"] = _points(logged.L / MM, step)[: len(values)]
            else:
                look |= {"x0": 0.5 * minutes, "dx": minutes}
            figure.add_scatter(row=number + 1, col=1, y=values, mode="lines", meta=scenario, **look)
            if len(values) and (not own or name in whole):
                ends += np.quantile(values, [OUTLIERS, 1.0 - OUTLIERS]).tolist()
        margin = max(0.08 * (max(ends) - min(ends)), 1e-3)
        layout[f"yaxis{number + 1 if number else ''}.range"] = [min(ends) - margin, max(ends) + margin]
    return layout


_DRAWN: dict[str, dict[str, Any]] = {
    "true": {"line": {"width": 1.5, "dash": "solid"}, "opacity": 1.0},
    "camera": {"line": {"width": 0.8, "dash": "solid"}, "opacity": 0.35},
    "shared": {"line": {"width": 1.5, "dash": "dash", "color": INK}, "opacity": 1.0, "showlegend": False},
}
"""Style of a line; those that are drawn for each controller have its colour."""


def _own_look(benchmark: Benchmark, case: Case, name: str, line: str, panel: int) -> dict[str, Any]:
    """Style of a controller's line, and its name in the legend, which the first panel's true radius shows."""
    titled = line == "true" and not panel
    rmse = f": {benchmark.values(case, name, RMSE.metric)[0, 0]:.3f} mm{', lost' * lost(benchmark, case, name)}"
    look = {"name": plain(name) + rmse * titled, "showlegend": titled, "legendgroup": name, **_DRAWN[line]}
    return look | {"line": {**_DRAWN[line]["line"], "color": looks_of(benchmark)[name].colour}}


def _lines(panel: Panel, names: Sequence[str]) -> list[tuple[str, str, bool]]:
    """Lines of a panel: name, controller, and whether each controller has one; else it is drawn once."""
    return [(line, name, line in OWN) for line in panel.lines for name in (names if line in OWN else names[:1])]


def _points(values: Floats, step: int) -> npt.NDArray[np.float32]:
    """Means over ``step`` steps each, up to the first value that is no number: a crystal that broke the equations."""
    steps = int(np.isfinite(values).cumprod().sum())
    blocks = values[: steps // step * step].reshape(-1, step)
    points: npt.NDArray[np.float32] = blocks.mean(axis=1).astype(np.float32)
    return points


def ring_bias(case: Case, seed: int) -> float:
    """Return the operator's bias of a seed's puller [m]: bright ring less radius at its own steady state.

    Zero for a whole crystal, which has no steady state.
    """
    if task_of(case).by_length:
        return 0.0
    env = CzEnv.from_config(case.config())
    env.reset(seed=seed)
    return float(env.get_state().slot.slot["puller"]["ring_bias"])


# ``report.html``: the benchmark as one page that opens from disk, and fetches nothing: tables, and plotly's pictures.
#
# Names come from agent files and are untrusted: they are escaped for HTML and for plotly.

BEST_NOTE = (
    "Of each kind the one that ranks first over these scenarios (crystals lost, then cost), and your own: RMSE [mm] on "
    "each. Cost and drives are those on the first."
)
ANSWER_NOTE = (
    "Mean cost a step, which counts radius error and moves; the difference is learned less classical, and is shown if "
    "its 95&nbsp;% interval, on the same crystals, leaves out zero. Crystals lost rank before cost, by the lower end "
    "of their interval."
)
_SLOT = re.compile(r"<!-- slot:(\w+) -->")


def page(benchmark: Benchmark, command: str) -> str:
    """Return the page; the same results give the same text."""
    case, contenders, task = benchmark.cases[0], benchmark.contenders, task_of(benchmark.cases[0])
    verdict, config = task.verdict(benchmark), case.config()
    most = max(len(benchmark.seeds(each)) for each in benchmark.cases)
    heads, groups = task.overview(benchmark.only(tables.deciding(benchmark), tables.best_of_each_kind(benchmark)))
    parts = {
        "style": _asset("page.css") + vector.STYLE,
        "plotly": get_plotlyjs(),
        "verdict": escape(" ".join((verdict.sentence, markdown.finding(benchmark).replace("`", "")))),
        "best": _table(heads, [(f"{name} [{kind}]", *cells) for kind, rows in groups.items() for name, *cells in rows]),
        "best_note": BEST_NOTE,
        "question": "Who ranks first where",
        "answer_note": ANSWER_NOTE,
        "limit": f"{config.radius_limit / MM:.3g}",
        "lede": f"{tables.count(len(contenders), 'controller')}, {tables.count(len(benchmark.cases), 'scenario')}, "
        f"up to {tables.crystals(most)} each, the same for everyone: at most {config.horizon / HOUR:.3g} h at one "
        f"action every {config.control_interval:g} s, on {case.grown_on}.",
        "scenarios": _table(verdict.heads, verdict.rows) if verdict.rows else "",
        "tables": "\n".join(_metrics(benchmark, each, is_open=each is case) for each in benchmark.cases),
        "result": vector.result(benchmark),
        "pareto": vector.pareto(benchmark),
        "crystal": _html(crystal(benchmark), "crystal"),
        "controllers": _table(tables.WHO, tables.who(contenders), "words"),
        "command": escape(command),
    }
    if case.tolerance is not None:
        parts |= _for_a_grower(benchmark)
    return _SLOT.sub(lambda slot: parts[slot[1]], _asset("page.html"))


def _for_a_grower(benchmark: Benchmark) -> dict[str, str]:
    """The parts of the page that differ on a puller."""
    tables_of = (
        f"<h3>{escape(case.name)}</h3>{_table(*markdown.outcome(benchmark, case))}" for case in benchmark.cases
    )
    return {
        "verdict": escape(markdown.recommendation(benchmark)),
        "best": f"<h2>{escape(markdown.title(benchmark.cases[0]))}</h2>{''.join(tables_of)}",
        "best_note": escape(" ".join((markdown.EXPLAINED, *markdown.warnings(benchmark)))),
        "question": "What the loops bear",
        "scenarios": _table(markdown.MARGINS, markdown.margins(benchmark)),
        "answer_note": escape(BEARS),
    }


def _html(figure: Figure, name: str) -> str:
    """A picture as plotly's own HTML, with a script that waits until the page runs it."""
    margin = {"l": 60, "r": 10, "t": 90, "b": 40}
    figure.update_layout(template="plotly_white", margin=margin, hoverlabel_namelength=-1)
    config = {"displayModeBar": False, "responsive": True}
    text: str = figure.to_html(config, full_html=False, include_plotlyjs=False, div_id=name)
    return text.replace("<script>", '<script type="text/plain">')


def _metrics(benchmark: Benchmark, case: Case, is_open: bool) -> str:
    """Every metric of a scenario, crystals lost and then the lowest cost first, to unfold."""
    error, drives = task_of(case).columns
    columns = (*error, *tables.comparison(benchmark, case), *drives)
    ranked = sorted(benchmark.contenders, key=lambda each: benchmark.rank([case], each.name))
    heads = "controller", *(column.heading for column in columns)
    rows = tables.rows(benchmark.only(contenders=ranked), case, columns)
    marks = (" [bound]" * each.bound for each in ranked)
    marked = [(f"{name}{mark}", *cells) for mark, (name, *cells) in zip(marks, rows, strict=True)]
    about = escape(f"{case.meaning}. {measured_from(benchmark, case).replace('`', '')}")
    return (
        f"<details{' open' if is_open else ''}><summary>{escape(case.name)} "
        f'({tables.crystals(len(benchmark.seeds(case)))})</summary><p class="note">{about}</p>'
        f"{_table(heads, marked)}</details>"
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
