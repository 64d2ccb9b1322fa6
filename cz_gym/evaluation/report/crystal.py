"""The figure of one disturbed crystal under one or more controllers."""

from collections.abc import Callable, Sequence
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from cz_gym.body.signals import Logged
from cz_gym.evaluation.results import Result, Sample
from cz_gym.evaluation.rollout import Floats
from cz_gym.support.units import KILO, MINUTE, MM, MM_PER_MIN

from .canvas import COLUMNS, GREY, INK, canvas, chosen, png, styles_of

ROOM = (0.01 * MM, 3.0 * MM)
"""Smallest and largest margin of the radius axis around the reference [m]."""
SMOOTH = 5.0 * MINUTE
"""Length of the running mean of the drives [s], drawn over their single steps."""


def example(sample: Sample) -> Any:
    """Return the signals of a sample's first crystal, which every sample of a run has."""
    if sample.example is None:
        raise ValueError(f"the sample of {sample.name} has no signals")
    return sample.example


class _Panel(NamedTuple):
    label: str
    value: Callable[[Logged], Floats]
    noisy: bool = False
    """Whether to draw single steps pale, with their running mean on top."""


_PANELS = (
    _Panel("crystal radius [mm]", lambda s: s.r_c / MM),
    _Panel("bright ring [mm]", lambda s: s.r_br / MM),
    _Panel("pull speed [mm/min]", lambda s: s.v_p / MM_PER_MIN, noisy=True),
    _Panel("heater power [kW]", lambda s: s.Q_H / KILO, noisy=True),
    _Panel("melt temperature [K]", lambda s: s.T_b),
)


class DrawnCrystal(NamedTuple):
    """A crystal under one controller."""

    title: str
    signals: Logged
    colour: str
    lost: bool


def draw(crystals: Sequence[DrawnCrystal], dt: float, title: str, tolerance: float = 0.0) -> Figure:
    """Draw a crystal under some controllers, at steps of ``dt`` [s], with a band of the tolerance [m] in grey."""
    figure = canvas(1.0 + min(max(1.62 * len(crystals), 4.0), 8.1), 7.6)
    axes = figure.subplots(len(_PANELS), len(crystals), sharex=True, sharey="row", squeeze=False)
    longest = max((crystal.signals for crystal in crystals), key=lambda signals: len(signals.r_c))
    for place, crystal in enumerate(crystals):
        if tolerance:
            ends = (longest.r_ref - tolerance) / MM, (longest.r_ref + tolerance) / MM
            axes[0, place].fill_between(_minutes(len(longest.r_ref), dt), *ends, color=GREY, alpha=0.3, lw=0)
        _draw(axes[:, place], crystal, dt, longest.r_ref)
    for row, panel in enumerate(_PANELS):
        axes[row, 0].set_ylabel(panel.label.replace(" [", "\n["))
    figure.align_ylabels(axes[:, 0])
    _set_limits(axes, crystals, longest, dt)
    figure.suptitle(title, fontsize=10.5)
    handles: list[Any] = [
        Line2D([], [], color=INK, lw=1.2, ls="--", label="reference"),
        Line2D([], [], color=GREY, lw=1.2, label="ring as the camera reports it"),
        Line2D([], [], ls="none", label="in colour: true value; of a drive, its 5 min mean over single steps"),
    ]
    if tolerance:
        handles.insert(1, Patch(color=GREY, alpha=0.3, lw=0, label=f"diameter within ±{2.0 * tolerance / MM:g} mm"))
    figure.legend(handles=handles, loc="outside lower center", fontsize=8.5, frameon=False)
    return figure


def crystal(result: Result) -> bytes:
    """Draw the first crystal of a scenario under the controllers of :func:`.chosen`."""
    samples, style = chosen(result.samples, COLUMNS), styles_of(result.samples)
    crystals = []
    for sample in samples:
        rmse = f"RMSE {sample.metric('rmse_mm')[0, 0]:.3g} mm"
        crystals.append(
            DrawnCrystal(f"{fill(sample.name, 18)}\n{rmse}", example(sample), style[sample.name].colour, lost(sample))
        )
    title = f"One crystal of {result.case.name} (test seed {samples[0].seeds[0]:,})"
    return png(draw(crystals, result.case.control_interval, title, result.case.tolerance or 0.0))


def _draw(axes: Any, crystal: DrawnCrystal, dt: float, reference: Floats) -> None:
    signals, colour = crystal.signals, crystal.colour
    minutes = _minutes(len(signals.r_c), dt)
    axes[0].plot(_minutes(len(reference), dt), reference / MM, color=INK, lw=1.0, ls="--", zorder=3)
    axes[1].plot(minutes, signals.r_br_measured / MM, color=GREY, lw=0.4)
    for axis, panel in zip(axes, _PANELS, strict=True):
        values = panel.value(signals)
        axis.plot(minutes, values, color=colour, **({"lw": 0.4, "alpha": 0.4} if panel.noisy else {"lw": 1.1}))
        if panel.noisy:
            window = min(max(round(SMOOTH / dt), 1), len(values))
            mean = np.convolve(values, np.full(window, 1.0 / window), "valid")
            axis.plot(minutes[window - 1 :] - 0.5 * (window - 1) * dt / MINUTE, mean, color=colour, lw=1.4)
        if crystal.lost:
            axis.axvline(minutes[-1], color=INK, lw=0.8, ls=":")
    axes[0].set_title(crystal.title + ", lost" * crystal.lost, fontsize=9, color=INK, fontweight="bold")
    axes[-1].set_xlabel("time [min]")


def lost(sample: Sample) -> bool:
    """Return whether the first crystal was lost, with the first training seed."""
    return bool(sample.metric("failure_rate")[0, 0])


def _set_limits(axes: Any, crystals: Sequence[DrawnCrystal], longest: Logged, dt: float) -> None:
    """Set the axes' limits by the crystals that were not lost; a lost one leaves the picture."""
    whole = [crystal.signals for crystal in crystals if not crystal.lost] or [crystal.signals for crystal in crystals]
    worst = max(float(np.abs(signals.r_c - signals.r_ref).max()) for signals in whole)
    width = 1.15 * float(np.clip(worst, *ROOM))
    ends = np.array([longest.r_ref.min() - width, longest.r_ref.max() + width])
    axes[0, 0].set_ylim(*(ends / MM))
    axes[1, 0].set_ylim(*((ends + np.median(longest.r_br - longest.r_c)) / MM))
    axes[0, 0].set_xlim(0.0, len(longest.r_c) * dt / MINUTE)
    axes[0, 0].xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 3, 6, 10]))
    for axis in axes.flat:
        axis.ticklabel_format(axis="y", useOffset=False)


def _minutes(steps: int, dt: float) -> Floats:
    return np.arange(1, steps + 1, dtype=np.float64) * (dt / MINUTE)
