"""The page's pictures of a scenario, drawn by plotly: error against pull activity, and errors crystal by crystal."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import Any

import numpy as np
from plotly import graph_objects as go

from cz_gym.evaluation.results import ScenarioResult
from cz_gym.evaluation.statistics import Estimate

from .canvas import MARKERS, Style
from .tables import ERROR, PULL_STEP, RMSE

LOG = {"type": "log", "exponentformat": "none"}
"""Plotly then writes powers of ten in full and small digits between them, which do not collide on a narrow screen."""
DISTRIBUTIONS = ERROR[:3]
"""Errors whose distribution over the crystals can be chosen."""
LONGEST = 32
"""Characters of a name that plots have room for."""


def plain(name: str) -> str:
    """A name as plotly may draw it: its own markup switched off, one line, not too long."""
    short = name if len(name) <= LONGEST else f"{name[: LONGEST - 1]}…"
    return escape("".join(letter if letter.isprintable() else " " for letter in short), quote=False)


def pareto(scenario: ScenarioResult, styles: Mapping[str, Style]) -> go.Figure:
    """Mean RMSE against mean pull step RMS with 95 % intervals, both logarithmic.

    A controller that never moves the pull speed stands left of all others.
    """
    figure = go.Figure()
    moving = [outcome.means[PULL_STEP.metric].mean for outcome in scenario.outcomes]
    floor = min((value for value in moving if value > 0.0), default=1.0) / 3.0
    for outcome in scenario.outcomes:
        error, activity = outcome.means[RMSE.metric], outcome.means[PULL_STEP.metric]
        still, style = activity.mean < floor, styles[outcome.controller.name]
        figure.add_scatter(
            name=plain(outcome.controller.name),
            x=[max(activity.mean, floor)],
            y=[error.mean],
            error_x={"visible": False} if still else _bars(activity),
            error_y=_bars(error),
            mode="markers+text",
            text="← 0" if still else "",
            textposition="bottom center",
            marker={"color": style.colour, "symbol": f"{MARKERS[style.marker]}-open", "size": 10, "line": {"width": 2}},
            hovertemplate=f"RMSE {RMSE.text(error)} mm<br>pull step RMS {PULL_STEP.text(activity)} mm/min",
        )
    figure.update_xaxes(LOG, title=f"mean {PULL_STEP.heading}", nticks=4)
    figure.update_yaxes(LOG, title=f"mean {RMSE.heading}")
    figure.update_layout(
        title="Error against pull activity:<br>lower left is better", legend={"orientation": "h", "y": -0.2}
    )
    return figure


def _bars(estimate: Estimate) -> dict[str, Any]:
    low, high = estimate.ends
    return {"symmetric": False, "array": [high - estimate.mean], "arrayminus": [estimate.mean - low]}


def errors(scenario: ScenarioResult, styles: Mapping[str, Style]) -> go.Figure:
    """Distribution of an error over the crystals, one box a controller, over all its training seeds."""
    figure = go.Figure()
    outcomes = scenario.outcomes[::-1]
    values = [
        [outcome.sample.metric(column.metric).ravel().astype(np.float32) for outcome in outcomes]
        for column in DISTRIBUTIONS
    ]
    for outcome, here in zip(outcomes, values[0], strict=True):
        colour = styles[outcome.controller.name].colour
        figure.add_box(name=plain(outcome.controller.name), x=here, marker={"color": colour, "size": 3})
    buttons = [
        {"label": column.heading, "method": "update", "args": [{"x": here}, {"xaxis.title.text": column.heading}]}
        for column, here in zip(DISTRIBUTIONS, values, strict=True)
    ]
    figure.update_xaxes(LOG, title=DISTRIBUTIONS[0].heading)
    menu = {"buttons": buttons, "x": 1, "xanchor": "right", "y": 1.02, "yanchor": "bottom"}
    figure.update_layout(title="Error by crystal", showlegend=False, updatemenus=[menu])
    return figure
