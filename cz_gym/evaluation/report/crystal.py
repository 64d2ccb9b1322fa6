"""The figure of one disturbed crystal under each controller."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.lines import Line2D

from cz_gym.evaluation.results import REFERENCE, Sample, ScenarioResult
from cz_gym.evaluation.rollout import Signals
from cz_gym.units import KILO, MINUTE, MM, MM_PER_MIN

from .canvas import GREY, INK, Style, canvas, png

Floats = npt.NDArray[np.float64]
COLUMNS = 6
"""Most controllers in the figure of one crystal."""
LEARNED = 2
"""Of them, most learned ones while there are others."""
WINDOW = 3.0 * MM
"""Largest radius error that the figure has room for, beyond the reference's own range [m]."""
NARROWEST = 0.01 * MM
"""Least room: a crystal that nothing disturbs has no error to scale by [m]."""


def crystal(scenario: ScenarioResult, style: dict[str, Style]) -> bytes:
    """The first crystal of a scenario under each controller: radius, ring, pull, heater, melt against time."""
    samples = _chosen([outcome.sample for outcome in scenario.outcomes])
    figure = canvas(2.35 * len(samples) + 1.0, 8.6)
    axes = figure.subplots(len(_PANELS), len(samples), sharex=True, sharey="row", squeeze=False)
    longest = max((sample.example for sample in samples), key=lambda signals: len(signals.r_c))
    for column, sample in enumerate(samples):
        _crystal_column(axes[:, column], sample, style[sample.controller.name].colour, longest.r_ref)
    for row, panel in enumerate(_PANELS):
        axes[row, 0].set_ylabel(panel.label)
    _crystal_limits(axes, samples, longest)
    figure.suptitle(_heading(scenario, samples), fontsize=11)
    figure.legend(
        handles=[
            Line2D([], [], color=INK, lw=1.2, ls="--", label="reference"),
            Line2D([], [], color=GREY, lw=1.2, label="what the camera reports"),
            Line2D([], [], color=INK, lw=1.2, label="true value, in the controller's colour"),
            Line2D([], [], color=INK, lw=1.6, label="5 min mean of a drive"),
        ],
        loc="outside lower center",
        ncols=2 if len(samples) < 3 else 4,
        fontsize=8.5,
        frameon=False,
    )
    return png(figure)


class _Panel(NamedTuple):
    label: str
    value: Callable[[Signals], Floats]
    noisy: bool = False
    """Whether to draw it pale, with its mean over five minutes on top."""


_PANELS = (
    _Panel("crystal radius [mm]", lambda s: s.r_c / MM),
    _Panel("bright ring [mm]", lambda s: s.r_br / MM),
    _Panel("pull speed [mm/min]", lambda s: s.v_p / MM_PER_MIN, noisy=True),
    _Panel("heater power [kW]", lambda s: s.Q_H / KILO, noisy=True),
    _Panel("melt temperature [K]", lambda s: s.T_b),
)
SMOOTH = 5.0 * MINUTE
"""Length of the running mean drawn over noisy signals [s]."""


def _chosen(samples: list[Sample]) -> list[Sample]:
    """At most :data:`COLUMNS`: the reference, the best learned, then the best of the others; bounds last.

    Best is the lowest mean RMSE.
    """
    ranked = sorted(samples, key=lambda sample: float(sample.metric("rmse_mm").mean()))
    learned = [sample.controller.name for sample in ranked if sample.controller.learned]
    best, more = learned[:LEARNED], learned[LEARNED:]

    def place(sample: Sample) -> tuple[bool, bool, bool, bool]:
        who = sample.controller
        return who.name != REFERENCE, who.name not in best, who.name in more, who.bound

    chosen = sorted(ranked, key=place)[:COLUMNS]
    return [sample for sample in samples if any(sample is one for one in chosen)]


def _heading(scenario: ScenarioResult, chosen: list[Sample]) -> str:
    """What the figure shows and, if there were more controllers, by which rule these were chosen."""
    text = f"One crystal of {scenario.row.name!r} (test seed {chosen[0].seeds[0]:,}) under each controller"
    names = {sample.controller.name for sample in chosen}
    others = [outcome.controller.name for outcome in scenario.outcomes if outcome.controller.name not in names]
    if not others:
        return text
    kinds = [REFERENCE] if REFERENCE in names else []
    learned = sum(sample.controller.learned for sample in chosen)
    kinds += [f"the {learned} best of the learned" if learned > 1 else "the best of the learned"] if learned else []
    kinds.append("the best of the others that read sensors")
    return f"{text}\nshown: {', '.join(kinds)}, by mean RMSE\nnot shown: {', '.join(others)}"


def _crystal_column(axes: Any, sample: Sample, colour: str, reference: Floats) -> None:
    signals, dt = sample.example, sample.control_interval
    minutes = _minutes(len(signals.r_c), dt)
    axes[0].plot(_minutes(len(reference), dt), reference / MM, color=INK, lw=1.0, ls="--", zorder=3)
    axes[1].plot(minutes, signals.r_br_measured / MM, color=GREY, lw=0.4)
    for axis, panel in zip(axes, _PANELS, strict=True):
        values = panel.value(signals)
        if panel.noisy:
            axis.plot(minutes, values, color=colour, lw=0.3, alpha=0.15)
            window = min(round(SMOOTH / dt), len(values))
            mean = np.convolve(values, np.full(window, 1.0 / window), "valid")
            axis.plot(minutes[window - 1 :] - 0.5 * (window - 1) * dt / MINUTE, mean, color=colour, lw=1.4)
        else:
            axis.plot(minutes, values, color=colour, lw=1.1)
    rmse = float(sample.metric("rmse_mm")[0, 0])
    axes[0].set_title(f"{sample.controller.name}\nRMSE {rmse:.3g} mm", fontsize=9, color=colour, fontweight="bold")
    axes[-1].set_xlabel("time [min]")
    if sample.metric("failure_rate")[0, 0] > 0.0:
        _mark_failure(axes, float(minutes[-1]))


def _mark_failure(axes: Any, minute: float) -> None:
    for axis in axes:
        axis.axvline(minute, color=INK, lw=0.8, ls=":")
    early = minute < 90.0
    axes[0].annotate(
        f"failed\nat {minute:.0f} min",
        (minute, 0.96),
        xycoords=("data", "axes fraction"),
        xytext=(3 if early else -3, 0),
        textcoords="offset points",
        ha="left" if early else "right",
        va="top",
        fontsize=7.5,
    )


def _crystal_limits(axes: Any, samples: list[Sample], longest: Signals) -> None:
    """Scale by the crystals that did not fail: one that did leaves the picture, it does not set the scale."""
    whole = [sample for sample in samples if not sample.metric("failure_rate")[0, 0]] or samples
    worst = max(float(np.abs(sample.example.r_c - sample.example.r_ref).max()) for sample in whole)
    width = 1.15 * max(min(worst, WINDOW), NARROWEST)
    low, high = float(longest.r_ref.min()) - width, float(longest.r_ref.max()) + width
    ring = float(np.median(longest.r_br - longest.r_c))
    axes[0, 0].set_ylim(low / MM, high / MM)
    axes[1, 0].set_ylim((low + ring) / MM, (high + ring) / MM)
    axes[0, 0].set_xlim(0.0, len(longest.r_c) * samples[0].control_interval / MINUTE)
    for axis in axes.flat:
        axis.ticklabel_format(axis="y", useOffset=False)


def _minutes(steps: int, dt: float) -> Floats:
    return np.arange(1, steps + 1, dtype=np.float64) * (dt / MINUTE)
