"""Parts of every figure: the style of each controller, a canvas without a display, PNG bytes."""

import io
import os
from collections.abc import Callable, Sequence
from itertools import cycle
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from PIL import Image

from cz_gym.body.signals import Logged
from cz_gym.support.units import KILO, MINUTE, MM, MM_PER_MIN

from .protocol import Contender
from .rollout import Floats

if "CZ_GYM_COMMAND" in os.environ:  # the reader's matplotlibrc is for the reader's own figures
    matplotlib.rcdefaults()

COLOURS = (
    "#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#4B0055", "#7F5FB0", "#8C6D1F",
    "#444444", "#A0A000", "#8B0000", "#005F5F", "#2A2AE0", "#E0218A", "#56B4E9", "#5FBF3F",
    "#FF00FF", "#FF004B", "#1E4B00", "#E178FF", "#E17869", "#690F2D", "#0078FF", "#8700A5",
)  # fmt: skip
"""Okabe and Ito's palette, safe for colour-blind readers, with more for a long table."""
MARKERS = {
    "o": "circle", "s": "square", "D": "diamond", "^": "triangle-up", "v": "triangle-down", "P": "cross", "*": "star",
    "X": "x", "p": "pentagon", "h": "hexagon", "<": "triangle-left", ">": "triangle-right",
}  # fmt: skip
"""Matplotlib's markers with plotly's names for them."""
DPI = 160
COLUMNS = 6
"""Largest number of controllers in the figure of a crystal: more would be too wide for a page."""
INK, GREY = "#222222", "#999999"


class Style(NamedTuple):
    """Colour and marker of a controller, the same in every figure of a run."""

    colour: str
    marker: str


def styles(names: Sequence[str]) -> dict[str, Style]:
    """Return one style a controller, in turn."""
    turns = zip(cycle(COLOURS), cycle(MARKERS))
    return {name: Style(*style) for name, style in zip(dict.fromkeys(names), turns, strict=False)}


def styles_of(contenders: Sequence[Contender]) -> dict[str, Style]:
    """Return one style a contender: the user's own come first, then the quoted, agents, and the others."""
    return styles([each.name for each in sorted(contenders, key=lambda c: (not c.own, not c.quoted, not c.learned))])


def canvas(width: float, height: float) -> Figure:
    """Return an empty figure of that size [in]."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def png(figure: Figure) -> bytes:
    """Return the figure as a PNG file, its axes in the house's style."""
    for axis in figure.axes:
        axis.grid(True, color="#dddddd", lw=0.5)
        axis.set_axisbelow(True)
        axis.spines[["top", "right"]].set_visible(False)
        axis.tick_params(which="both", labelsize=8)
        axis.tick_params(which="minor", pad=5.0)  # level with the longer ticks' numbers
        axis.xaxis.label.set_fontsize(8.5)
        axis.yaxis.label.set_fontsize(8.5)
    image = io.BytesIO()
    figure.savefig(image, dpi=DPI, format="png", metadata={"Software": None})
    # At most 256 colours make a third of the size; figures have few.
    palette = Image.open(image).convert("RGB").quantize(256, dither=Image.Dither.NONE)
    packed = io.BytesIO()
    palette.save(packed, format="png", optimize=True)
    return packed.getvalue()


# The figure of one disturbed crystal under one or more controllers.

ROOM = (0.01 * MM, 3.0 * MM)
"""Smallest and largest margin of the radius axis around the reference [m]."""
SMOOTH = 5.0 * MINUTE
"""Length of the running mean of the drives [s], drawn over their single steps."""


class _Panel(NamedTuple):
    label: str
    value: Callable[[Logged], Floats]
    noisy: bool = False
    """True to draw single steps pale, with their running mean on top."""


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
