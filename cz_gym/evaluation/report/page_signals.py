"""The page's crystals: every signal of the first episodes in panels over one time axis, rounded and packed small.

A packed text is base64 of zlib's deflate of 32-bit differences along time, in steps of the panel's resolution: first
the low bytes of all numbers, then the next ones.
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from plotly import graph_objects as go
from plotly.subplots import make_subplots

from cz_gym.config import Config
from cz_gym.evaluation.metrics import TOLERANCE
from cz_gym.evaluation.results import REFERENCE, Controller, Sample, ScenarioResult
from cz_gym.evaluation.rollout import Floats, Signals
from cz_gym.units import KILO, MINUTE, MM, MM_PER_MIN
from cz_gym.vector import CzVectorEnv

from .canvas import GREY, INK, Style
from .page_figures import plain

OUTLIERS = 0.001
"""Share of the values at either end that a panel's range need not hold."""


class Panel(NamedTuple):
    """Lines over time that share an axis."""

    title: str
    unit: str
    scale: float
    """The unit in SI."""
    resolution: float
    """Values are rounded to a multiple of this [unit]."""
    lines: Mapping[str, Callable[[Signals, float], Floats]]
    """From an episode's signals and the operator's bias [m], in SI: ``true``, and by what the ``camera`` reports, of
    each controller; any other is what all controllers are asked for or meet."""
    levels: tuple[float, ...] = ()
    """Values that are marked [unit]."""
    smooth: bool = False
    """Whether a controller's chatter may fill the panel: its ``mean`` over the last five minutes is drawn on top."""


PANELS = (
    Panel("crystal radius", "mm", MM, 0.001, {"true": lambda s, bias: s.r_c, "reference": lambda s, bias: s.r_ref}),
    Panel(
        "radius error", "mm", MM, 0.001,
        {"camera": lambda s, bias: s.r_br_measured - bias - s.r_ref, "true": lambda s, bias: s.r_c - s.r_ref},
        (-TOLERANCE / MM, 0.0, TOLERANCE / MM),
    ),
    Panel(
        "bright ring less radius", "mm", MM, 0.001,
        {
            "camera": lambda s, bias: s.r_br_measured - bias - s.r_c,
            "true": lambda s, bias: s.r_br - bias - s.r_c,
            "hidden offset": lambda s, bias: s.ring_offset,
        },
        (0.0,),
    ),
    Panel("pull speed", "mm/min", MM_PER_MIN, 0.0005, {"true": lambda s, bias: s.v_p}, smooth=True),
    Panel("growth rate", "mm/min", MM_PER_MIN, 0.0005, {"true": lambda s, bias: s.v_g}),
    Panel("heater power", "kW", KILO, 0.001, {"true": lambda s, bias: s.Q_H}, smooth=True),
    Panel("heater temperature", "K", 1.0, 0.01, {"true": lambda s, bias: s.T_1, "recipe": lambda s, bias: s.T_1_ref}),
    Panel("melt temperature", "K", 1.0, 0.001, {"true": lambda s, bias: s.T_b}),
    Panel("meniscus height", "mm", MM, 0.001, {"true": lambda s, bias: s.h_c}),
    Panel("growth angle", "deg", np.pi / 180.0, 0.001, {"true": lambda s, bias: s.alpha_c}, (0.0,)),
)  # fmt: skip
_LINES = [
    (panel, name) for panel in range(len(PANELS)) for name in (*PANELS[panel].lines, *["mean"] * PANELS[panel].smooth)
]
OWN = [(panel, name) for panel, name in _LINES if name in ("true", "camera", "mean")]
"""Panel and name of the lines that each controller has, in the order in which they are packed."""
SHARED = [line for line in _LINES if line not in OWN]
"""Of those that are the same for all controllers."""


def crystals(scenario: ScenarioResult) -> list[dict[str, Any]]:
    """The scenario's episodes with signals: seed, the panels' ranges, packed lines by controller, then the shared ones.

    A panel's range is that of the crystals that were not lost: one that was leaves the panel.
    """
    samples = [outcome.sample for outcome in scenario.outcomes]
    seeds = scenario.seeds[: max(len(sample.examples) for sample in samples)]
    config, found = scenario.row.config(), []
    for i, (seed, bias) in enumerate(zip(seeds, ring_biases(config, seeds), strict=True)):
        met = [sample.examples[i] if i < len(sample.examples) else None for sample in samples]
        runs = [_values(OWN, signals, bias, config.control_interval) if signals else None for signals in met]
        longest = max((signals for signals in met if signals), key=lambda s: len(s.r_c))
        shared = _values(SHARED, longest, bias, config.control_interval)
        there = [(run, sample) for run, sample in zip(runs, samples, strict=True) if run]
        whole = [run for run, sample in there if not _lost(sample, i)] or [run for run, _ in there]
        found.append(
            {
                "seed": f"{seed:,}",
                "names": [_name(sample, i) for sample in samples],
                "ranges": [_range(panel, [*whole, shared]) for panel in range(len(PANELS))],
                "packed": [run and pack(run) for run in [*runs, shared]],
            }
        )
    return found


SMOOTH = 5.0 * MINUTE
"""Length of the running mean [s]."""


def running_mean(values: Floats, interval: float) -> Floats:
    """The mean of each value and those of the SMOOTH seconds before it, as far as there are any."""
    size = max(round(SMOOTH / interval), 1)
    sums = np.concatenate([[0.0], np.cumsum(values)])
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(ends - size, 0)
    mean: Floats = (sums[ends] - sums[starts]) / (ends - starts)
    return mean


Line = tuple[int, Floats]
"""Its panel, and values in the panel's unit."""


def _values(lines: Sequence[tuple[int, str]], signals: Signals, bias: float, interval: float) -> list[Line]:
    """The lines, up to the first step at which one is no number: a crystal that broke the equations."""

    def line(panel: Panel, name: str) -> Floats:
        found = panel.lines["true" if name == "mean" else name](signals, bias) / panel.scale
        return running_mean(found, interval) if name == "mean" else found

    values = np.array([line(PANELS[panel], name) for panel, name in lines])
    steps = int(np.isfinite(values).all(axis=0).cumprod().sum())
    return [(panel, each[:steps]) for (panel, _), each in zip(lines, values, strict=True)]


def _lost(sample: Sample, i: int) -> bool:
    return bool(sample.metric("failure_rate")[0, i])


def _name(sample: Sample, i: int) -> str:
    """The controller's name with its RMSE on that crystal."""
    if i >= len(sample.examples):
        return f"{plain(sample.controller.name)}: not run"
    lost = ", lost" if _lost(sample, i) else ""
    return f"{plain(sample.controller.name)}: {sample.metric('rmse_mm')[0, i]:.3f} mm{lost}"


def _range(panel: int, runs: Sequence[Sequence[Line]]) -> tuple[float, float]:
    ends = list(PANELS[panel].levels)
    for values in (values for run in runs for where, values in run if where == panel and len(values)):
        ends += np.quantile(values, [OUTLIERS, 1.0 - OUTLIERS]).tolist()
    margin = max(0.08 * (max(ends) - min(ends)), 5.0 * PANELS[panel].resolution)
    return min(ends) - margin, max(ends) + margin


def ring_biases(config: Config, seeds: Sequence[int]) -> tuple[float, ...]:
    """The operator's bias of each seed's puller [m]: bright ring less radius at its own steady state."""
    env = CzVectorEnv.from_config(config, len(seeds))
    env.reset(seed=list(seeds))
    states = env.get_state()
    env.close()
    return tuple(float(state.slot.slot["puller"]["ring_bias"]) for state in states)


def pack(lines: Sequence[Line]) -> str:
    """Lines of one length as a text, which ``html/page.js`` unpacks."""
    whole = [np.rint(values / PANELS[panel].resolution) for panel, values in lines]
    changes = np.diff(whole, axis=1, prepend=0.0).astype("<i4")
    return base64.b64encode(zlib.compress(changes.reshape(-1, 1).view(np.uint8).T.tobytes(), 9)).decode("ascii")


def frame(
    controllers: Sequence[Controller], best: Sequence[str], styles: Mapping[str, Style], horizon: float
) -> go.Figure:
    """The panels over the ``horizon`` [s], without values: traces in the order in which a crystal's lines are packed.

    The user's own, the reference and the ``best`` are drawn; a click in the legend draws others.
    """
    titles = [f"{panel.title} [{panel.unit}]" for panel in PANELS]
    figure = make_subplots(len(PANELS), 1, shared_xaxes=True, vertical_spacing=0.02, subplot_titles=titles)
    some = {each.name for each in controllers if each.own or each.name in (REFERENCE, *best)}
    for group, controller in enumerate(controllers):
        style, drawn = styles[controller.name], controller.name in some or not some
        for number, (panel, name) in enumerate(OWN):
            bold = name == ("mean" if PANELS[panel].smooth else "true")
            figure.add_scatter(
                row=panel + 1, col=1, x=[], y=[], mode="lines", legendgroup=f"{group}", showlegend=number == 0,
                line={"color": style.colour, "dash": style.dash, "width": 1.5 if bold else 0.8},
                opacity=1.0 if bold else 0.35, visible=True if drawn else "legendonly",
            )  # fmt: skip
    for panel, name in SHARED:
        line = {"color": INK, "dash": "dash", "width": 1.3}
        figure.add_scatter(row=panel + 1, col=1, x=[], y=[], name=name, mode="lines", line=line, showlegend=False)
    for panel in range(len(PANELS)):
        for level in PANELS[panel].levels:
            figure.add_hline(
                level, row=panel + 1, col=1, line={"color": GREY, "width": 1, "dash": "dot"}, layer="below"
            )
    # Ten numbers at most: 0, 20 ... 180 min, and finer ones in a zoom.
    figure.update_xaxes(range=[0.0, horizon / MINUTE], hoverformat=".2f", nticks=10)
    figure.update_xaxes(title="time [min]", row=len(PANELS), col=1)
    legend = {"orientation": "h", "y": 1.02, "yanchor": "bottom", "groupclick": "togglegroup"}
    return figure.update_layout(legend=legend, height=150 * len(PANELS), hovermode="x", uirevision="same")
