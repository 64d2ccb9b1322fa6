"""Plotly's pictures, one scenario shown at a time: error against pull activity, and signals of its first crystal."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from html import escape
from importlib.resources import files
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from plotly import graph_objects as go
from plotly.graph_objects import Figure
from plotly.offline import get_plotlyjs
from plotly.subplots import make_subplots

from cz_gym.body.signals import TOLERANCE
from cz_gym.crystal.process import CRYSTAL
from cz_gym.env import CzEnv
from cz_gym.evaluation.plots import COLUMNS, GREY, INK, MARKERS, Style, chosen, example, lost, styles_of
from cz_gym.evaluation.protocol import Case
from cz_gym.evaluation.results import Result
from cz_gym.evaluation.rollout import Floats
from cz_gym.evaluation.statistics import Estimate
from cz_gym.support.units import HOUR, KILO, MINUTE, MM, MM_PER_MIN

from . import markdown, tables
from .crystals import contents_of
from .figures import floor_of
from .markdown import measured_from
from .tables import PULL_STEP, RMSE

LOG = {"type": "log", "exponentformat": "none"}
"""Logarithmic axis on which plotly writes powers of ten in full, with small digits between them."""
LONGEST = 32
"""Longest name that plots have room for [characters]."""


def plain(name: str) -> str:
    """Return a name as plotly may draw it: its own markup switched off, one line, not too long."""
    short = name if len(name) <= LONGEST else f"{name[: LONGEST - 1]}…"
    return escape("".join(letter if letter.isprintable() else " " for letter in short), quote=False)


def add_menu(figure: go.Figure, results: Sequence[Result], layouts: Sequence[Mapping[str, Any]] = ()) -> None:
    """Add a menu that shows the traces of one scenario, with its layout; a trace's meta is its scenario's number."""
    buttons = []
    for number, result in enumerate(results):
        arguments: list[Any] = [{"visible": [trace.meta == number for trace in figure.data]}]
        arguments += [dict(layouts[number])] if layouts else []
        buttons.append({"label": plain(result.case.name), "method": "update", "args": arguments})
    figure.for_each_trace(lambda trace: trace.update(visible=trace.meta == 0))
    menu = {"buttons": buttons, "x": 0, "xanchor": "left", "y": 1, "yanchor": "bottom", "pad": {"b": 28}}
    figure.update_layout(updatemenus=[menu] if len(results) > 1 else [], **(layouts[0] if layouts else {}))


def pareto(results: Sequence[Result]) -> go.Figure:
    """Draw mean RMSE against mean pull step RMS with 95 % intervals; who never moves the pull speed stands leftmost."""
    figure, styles = go.Figure(), styles_of(results[0].samples)
    for number, result in enumerate(results):
        floor = floor_of([result])
        for name, means in result.means.items():
            error, activity = means[RMSE.metric], means[PULL_STEP.metric]
            still, style = activity.mean < floor, styles[name]
            figure.add_scatter(
                name=plain(name),
                meta=number,
                x=[max(activity.mean, floor)],
                y=[error.mean],
                error_x={"visible": False} if still else _bars(activity),
                error_y=_bars(error),
                mode="markers+text",
                text="← 0" if still else "",
                textposition="bottom center",
                marker={"color": style.colour, "symbol": f"{MARKERS[style.marker]}-open", "size": 10, "line_width": 2},
                hovertemplate=f"RMSE {RMSE.text(error)} mm<br>pull step RMS {PULL_STEP.text(activity)} mm/min",
            )
    figure.update_xaxes(LOG, title=f"mean {PULL_STEP.heading}", nticks=4)
    figure.update_yaxes(LOG, title=f"mean {RMSE.heading}")
    figure.update_layout(
        height=560, legend={"orientation": "h", "y": 0, "yref": "container", "yanchor": "bottom"}, showlegend=True
    )
    add_menu(figure, results)
    return figure


def _bars(estimate: Estimate) -> dict[str, Any]:
    low, high = estimate.ends
    return {"symmetric": False, "array": [high - estimate.mean], "arrayminus": [estimate.mean - low]}


POINT = 45.0
"""Time over which a point is the mean [s]."""
OUTLIERS = 0.001
"""Share of the values at either end that may lie outside a panel's range [-]."""


class Panel(NamedTuple):
    """Lines over time that share an axis."""

    title: str
    unit: str
    scale: float
    """Size of the unit in SI units."""
    lines: Mapping[str, Callable[[Any, float], Floats]]
    """Lines by name, each a function of an episode's signals and the operator's bias [m], in SI units. "true" and
    "camera" (its reading) are drawn for each controller; other lines are the same for all and drawn once."""
    levels: tuple[float, ...] = ()
    """Values that are marked [unit]."""


PANELS = (
    Panel(
        "radius error", "mm", MM,
        {"camera": lambda s, bias: s.r_br_measured - bias - s.r_ref, "true": lambda s, bias: s.r_c - s.r_ref},
        (-TOLERANCE / MM, 0.0, TOLERANCE / MM),
    ),
    Panel(
        "bright ring less radius", "mm", MM,
        {
            "camera": lambda s, bias: s.r_br_measured - bias - s.r_c,
            "true": lambda s, bias: s.r_br - bias - s.r_c,
            "hidden offset": lambda s, bias: s.ring_offset,
        },
        (0.0,),
    ),
    Panel("pull speed", "mm/min", MM_PER_MIN, {"true": lambda s, bias: s.v_p}),
    Panel("growth rate", "mm/min", MM_PER_MIN, {"true": lambda s, bias: s.v_g}),
    Panel("heater power", "kW", KILO, {"true": lambda s, bias: s.Q_H}),
    Panel("heater temperature", "K", 1.0, {"true": lambda s, bias: s.T_1, "recipe": lambda s, bias: s.T_1_ref}),
    Panel("melt temperature", "K", 1.0, {"true": lambda s, bias: s.T_b}),
    Panel("meniscus height", "mm", MM, {"true": lambda s, bias: s.h_c}),
    Panel("growth angle", "deg", np.pi / 180.0, {"true": lambda s, bias: s.alpha_c}, (0.0,)),
)  # fmt: skip
_RECIPES: dict[str, Callable[[Any, float], Floats]] = {
    "pull speed": lambda s, bias: s.v_p_ref,
    "heater power": lambda s, bias: s.Q_H_ref,
    "meniscus height": lambda s, bias: s.h_ref,
}
CRYSTAL_PANELS = (
    PANELS[0]._replace(lines={"true": PANELS[0].lines["true"]}),
    PANELS[1]._replace(levels=()),
    *(each._replace(lines={**each.lines, "recipe": line} if (line := _RECIPES.get(each.title)) else each.lines)
      for each in PANELS[2:]),
    Panel("v/G by the recipe's", "1", 1.0, {"true": lambda s, bias: s.v_over_G}, (1.0,)),
)  # fmt: skip
"""Panels of a whole crystal, against its length; the ring is not where the recipe's ring is while the radius is off."""
OWN = ("true", "camera")
"""Lines that are drawn for each controller."""


def crystal(results: Sequence[Result]) -> go.Figure:
    """Draw the first crystal of each scenario, one scenario at a time, under the controllers of :func:`chosen`."""
    whole = results[0].case.process == CRYSTAL
    panels = CRYSTAL_PANELS if whole else PANELS
    titles = [f"{panel.title} [{panel.unit}]" for panel in panels]
    figure = make_subplots(len(panels), 1, shared_xaxes=True, vertical_spacing=0.02, subplot_titles=titles)
    styles = styles_of(results[0].samples)
    layouts = [_draw(figure, number, result, styles, panels) for number, result in enumerate(results)]
    for row, panel in enumerate(panels, 1):
        for level in panel.levels:
            line = {"color": GREY, "width": 1, "dash": "dot"}
            figure.add_hline(level, row=row, col=1, line=line, layer="below")
    if not whole:
        figure.update_xaxes(range=[0.0, results[0].case.config().horizon / MINUTE])
    figure.update_xaxes(hoverformat=".2f", nticks=10)
    figure.update_xaxes(title="length [mm]" if whole else "time [min]", row=len(panels), col=1)
    legend = {"orientation": "h", "y": -0.04, "yanchor": "top", "groupclick": "togglegroup"}
    figure.update_layout(legend=legend, height=150 * len(panels), hovermode="x")
    add_menu(figure, results, layouts)
    return figure


def _draw(
    figure: go.Figure, scenario: int, result: Result, styles: Mapping[str, Style], panels: Sequence[Panel]
) -> dict[str, Any]:
    """Add the lines of a scenario and return the ranges of its panels: those of the crystals that were not lost."""
    samples, interval = chosen(result.samples, COLUMNS), result.case.control_interval
    by_length = result.case.process == CRYSTAL
    bias = 0.0 if by_length else ring_bias(result.case, result.seeds[0])
    step = max(round(POINT / interval), 1)
    time = {"x0": 0.5 * step * interval / MINUTE, "dx": step * interval / MINUTE}
    longest = max(map(example, samples), key=lambda signals: len(signals.r_c))
    whole = [sample.name for sample in samples if not lost(sample)] or [sample.name for sample in samples]
    layout: dict[str, Any] = {}
    for number, panel in enumerate(panels):
        ends = list(panel.levels)
        for name, function in panel.lines.items():
            for sample in samples if name in OWN else samples[:1]:
                own = name in OWN
                signals = example(sample) if own else longest
                values = _points(function(signals, bias) / panel.scale, step)
                places = {"x": _points(signals.L / MM, step)[: len(values)]} if by_length else time
                look = {"name": plain(sample.name) if own else name, "showlegend": False}
                if own and not number and name == "true":
                    rmse = f"{sample.metric('rmse_mm')[0, 0]:.3f} mm{', lost' if lost(sample) else ''}"
                    look = {"name": f"{look['name']}: {rmse}", "showlegend": True}
                style = styles[sample.name]
                line = {"color": style.colour if own else INK, "width": 0.8 if name == "camera" else 1.5}
                figure.add_scatter(
                    row=number + 1, col=1, y=values, **places, **look, mode="lines",
                    line={**line, "dash": "solid" if own else "dash"}, opacity=0.35 if name == "camera" else 1.0,
                    legendgroup=sample.name if own else name, meta=scenario,
                )  # fmt: skip
                if len(values) and (not own or sample.name in whole):
                    ends += np.quantile(values, [OUTLIERS, 1.0 - OUTLIERS]).tolist()
        margin = max(0.08 * (max(ends) - min(ends)), 1e-3)
        layout[f"yaxis{number + 1 if number else ''}.range"] = [min(ends) - margin, max(ends) + margin]
    return layout


def _points(values: Floats, step: int) -> npt.NDArray[np.float32]:
    """Means over ``step`` steps each, up to the first value that is no number: a crystal that broke the equations."""
    steps = int(np.isfinite(values).cumprod().sum())
    blocks = values[: steps // step * step].reshape(-1, step)
    points: npt.NDArray[np.float32] = blocks.mean(axis=1).astype(np.float32)
    return points


def ring_bias(case: Case, seed: int) -> float:
    """Return the operator's bias of a seed's puller [m]: bright ring less radius at its own steady state."""
    env = CzEnv.from_config(case.config())
    env.reset(seed=seed)
    return float(env.get_state().slot.slot["puller"]["ring_bias"])


# ``report.html``: the benchmark as one page that opens from disk, and fetches nothing: tables, and plotly's pictures.
#
# Names come from agent files and are untrusted: they are escaped for HTML and for plotly.

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
    tables_of = (f"<h3>{escape(result.case.name)}</h3>{_table(*markdown.outcome(result))}" for result in results)
    return {
        "verdict": escape(markdown.recommendation(results)),
        "best": f"<h2>{escape(markdown.title(results[0].case))}</h2>{''.join(tables_of)}",
        "best_note": escape(markdown.EXPLAINED),
        "question": "What the loops bear",
        "scenarios": _table(markdown.MARGINS, markdown.margins(results[0].samples, results[0])),
        "answer_note": escape(markdown.MARGINS_EXPLAINED),
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
