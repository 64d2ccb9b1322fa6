"""Plotly's picture of the first crystal of every scenario: signals of some controllers in panels over one time axis."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from plotly import graph_objects as go
from plotly.subplots import make_subplots

from cz_gym.evaluation.metrics import TOLERANCE
from cz_gym.evaluation.protocol import Row
from cz_gym.evaluation.results import Result, Sample
from cz_gym.evaluation.rollout import Floats, Signals
from cz_gym.units import KILO, MINUTE, MM, MM_PER_MIN
from cz_gym.vector import CzVectorEnv

from .canvas import GREY, INK, Style, chosen
from .crystal import example, lost
from .page_pictures import add_menu, plain

POINT = 45.0
"""Time over which a point is the mean [s]."""
MOST = 5
"""Most controllers whose signals are on the page, so that it stays small."""
OUTLIERS = 0.001
"""Share of the values at either end that a panel's range need not hold."""


class Panel(NamedTuple):
    """Lines over time that share an axis."""

    title: str
    unit: str
    scale: float
    """The unit in SI."""
    lines: Mapping[str, Callable[[Signals, float], Floats]]
    """Functions of an episode's signals and the operator's bias [m], in SI: ``true``, and what the ``camera`` reports,
    of each controller; any other is what all controllers are asked for or meet."""
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
OWN = ("true", "camera")
"""Lines that each controller has of its own."""


def crystal(results: Sequence[Result], styles: Mapping[str, Style]) -> go.Figure:
    """Draw the first crystal of each scenario, one scenario at a time, under the controllers of :func:`chosen`."""
    titles = [f"{panel.title} [{panel.unit}]" for panel in PANELS]
    figure = make_subplots(len(PANELS), 1, shared_xaxes=True, vertical_spacing=0.02, subplot_titles=titles)
    layouts = [_draw(figure, number, result, styles) for number, result in enumerate(results)]
    for row, panel in enumerate(PANELS, 1):
        for level in panel.levels:
            line = {"color": GREY, "width": 1, "dash": "dot"}
            figure.add_hline(level, row=row, col=1, line=line, layer="below")
    figure.update_xaxes(range=[0.0, results[0].row.config().horizon / MINUTE], hoverformat=".2f", nticks=10)
    figure.update_xaxes(title="time [min]", row=len(PANELS), col=1)
    legend = {"orientation": "h", "y": -0.04, "yanchor": "top", "groupclick": "togglegroup"}
    figure.update_layout(legend=legend, height=150 * len(PANELS), hovermode="x")
    add_menu(figure, results, layouts)
    return figure


def _draw(figure: go.Figure, scenario: int, result: Result, styles: Mapping[str, Style]) -> dict[str, Any]:
    """Add the lines of a scenario and return the ranges of its panels: those of the crystals that were not lost."""
    samples, interval = chosen(result.samples, MOST), result.row.control_interval
    bias, step = ring_bias(result.row, result.seeds[0]), max(round(POINT / interval), 1)
    time = {"x0": 0.5 * step * interval / MINUTE, "dx": step * interval / MINUTE}
    longest = max(map(example, samples), key=lambda signals: len(signals.r_c))
    whole = [sample.name for sample in samples if not lost(sample)] or [sample.name for sample in samples]
    layout: dict[str, Any] = {}
    for number, panel in enumerate(PANELS):
        ends = list(panel.levels)
        for name, function in panel.lines.items():
            for sample in samples if name in OWN else samples[:1]:
                own = name in OWN
                values = _points(function(example(sample) if own else longest, bias) / panel.scale, step)
                if own and not number and name == "true":
                    look = {"name": _name(sample), "showlegend": True}
                else:
                    look = {"name": plain(sample.name) if own else name, "showlegend": False}
                style = styles[sample.name]
                line = {"color": style.colour if own else INK, "width": 0.8 if name == "camera" else 1.5}
                figure.add_scatter(
                    row=number + 1, col=1, y=values, **time, **look, mode="lines",
                    line={**line, "dash": style.dash if own else "dash"}, opacity=0.35 if name == "camera" else 1.0,
                    legendgroup=sample.name if own else name, meta=scenario,
                )  # fmt: skip
                if len(values) and (not own or sample.name in whole):
                    ends += np.quantile(values, [OUTLIERS, 1.0 - OUTLIERS]).tolist()
        margin = max(0.08 * (max(ends) - min(ends)), 1e-3)
        layout[f"yaxis{number + 1 if number else ''}.range"] = [min(ends) - margin, max(ends) + margin]
    return layout


def _points(values: Floats, step: int) -> npt.NDArray[np.float32]:
    """Means of so many steps each, up to the first that is no number: a crystal that broke the equations."""
    steps = int(np.isfinite(values).cumprod().sum())
    blocks = values[: steps // step * step].reshape(-1, step)
    points: npt.NDArray[np.float32] = blocks.mean(axis=1).astype(np.float32)
    return points


def _name(sample: Sample) -> str:
    """The contender's name with its RMSE on that crystal."""
    return f"{plain(sample.name)}: {sample.metric('rmse_mm')[0, 0]:.3f} mm{', lost' if lost(sample) else ''}"


def ring_bias(row: Row, seed: int) -> float:
    """Return the operator's bias of a seed's puller [m]: bright ring less radius at its own steady state."""
    env = CzVectorEnv.from_config(row.config(), 1)
    env.reset(seed=[seed])
    (state,) = env.get_state()
    env.close()
    return float(state.slot.slot["puller"]["ring_bias"])
