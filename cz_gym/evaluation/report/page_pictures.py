"""Plotly's pictures, one scenario shown at a time: error against pull activity, and errors crystal by crystal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
from plotly import graph_objects as go

from cz_gym.evaluation.results import Result
from cz_gym.evaluation.statistics import Estimate

from .canvas import MARKERS, Style
from .figures import floor_of
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
        buttons.append({"label": plain(result.row.name), "method": "update", "args": arguments})
    figure.for_each_trace(lambda trace: trace.update(visible=trace.meta == 0))
    menu = {"buttons": buttons, "x": 0, "xanchor": "left", "y": 1, "yanchor": "bottom", "pad": {"b": 8}}
    figure.update_layout(updatemenus=[menu] if len(results) > 1 else [], **(layouts[0] if layouts else {}))


def pareto(results: Sequence[Result], styles: Mapping[str, Style]) -> go.Figure:
    """Draw mean RMSE against mean pull step RMS with 95 % intervals, both logarithmic.

    A controller that never moves the pull speed stands left of all others.
    """
    figure = go.Figure()
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
    figure.update_layout(height=560, legend={"orientation": "h", "y": -0.2}, showlegend=True)
    add_menu(figure, results)
    return figure


def _bars(estimate: Estimate) -> dict[str, Any]:
    low, high = estimate.ends
    return {"symmetric": False, "array": [high - estimate.mean], "arrayminus": [estimate.mean - low]}


def errors(results: Sequence[Result], styles: Mapping[str, Style]) -> go.Figure:
    """Draw the distribution of RMSE over the crystals and training seeds: median, quartiles, 5 to 95 %."""
    figure = go.Figure()
    for number, result in enumerate(results):
        for sample in reversed(result.samples):
            low, first, median, third, high = (
                [float(each)] for each in np.quantile(sample.metric(RMSE.metric), [0.05, 0.25, 0.5, 0.75, 0.95])
            )
            figure.add_box(
                y=[plain(sample.name)], lowerfence=low, q1=first, median=median, q3=third, upperfence=high,
                orientation="h", marker={"color": styles[sample.name].colour}, name=plain(sample.name), meta=number,
            )  # fmt: skip
    figure.update_xaxes(LOG, title=RMSE.heading)
    figure.update_yaxes(automargin=True)
    figure.update_layout(showlegend=False, height=140 + 24 * len(results[0].samples))
    add_menu(figure, results)
    return figure
