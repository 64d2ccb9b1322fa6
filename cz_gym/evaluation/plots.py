"""Parts of every figure: the style of each controller, a canvas without a display, PNG bytes."""

import io
import os
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple
from zlib import crc32

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

from .rollout import Floats

if "CZ_GYM_COMMAND" in os.environ:  # the reader's matplotlibrc is for the reader's own figures
    matplotlib.rcdefaults()

Vertices = tuple[tuple[float, float], ...]


def _polygon(corners: int, inner: float = 1.0, turn: float = 90.0, across: float = 1.0) -> Vertices:
    """Corners of a polygon in the unit circle, every other one drawn in to ``inner``; ``turn`` in degrees."""
    angles = np.deg2rad(turn) + np.arange(corners) * 2.0 * np.pi / corners
    radii = np.where(np.arange(corners) % 2, inner, 1.0)
    points = zip(across * radii * np.cos(angles), radii * np.sin(angles), strict=True)
    return tuple((round(float(x), 3), round(float(y), 3)) for x, y in points)


MARKS = {
    "circle": _polygon(24),
    "square": _polygon(4, turn=45.0),
    "triangle": _polygon(3),
    "flag": _polygon(3, turn=270.0),
    "pentagon": _polygon(5),
    "cross": _polygon(8, 0.35, turn=45.0),
    "bar": _polygon(4, turn=45.0, across=0.4),
    "sun": _polygon(12, 0.55),
    "diamond": _polygon(4),
    "tall diamond": _polygon(4, across=0.5),
    "wide diamond": ((0.0, 0.55), (1.2, 0.0), (0.0, -0.55), (-1.2, 0.0)),
    "kite": ((0.0, 0.7), (0.75, 0.2), (0.0, -1.0), (-0.75, 0.2)),
}
"""Marks as polygons about the unit circle, y up: of classical controllers, then, each a kind of diamond, of agents."""
LEARNED = ("diamond", "tall diamond", "wide diamond", "kite")
"""Marks of agents."""
DASHES: tuple[tuple[float, ...], ...] = (
    (), (5.0, 2.0), (1.5, 1.5), (6.0, 2.0, 1.5, 2.0),
    (9.0, 3.0), (3.0, 1.0), (5.0, 1.5, 1.0, 1.5, 1.0, 1.5), (2.0, 4.0),
)  # fmt: skip
"""Dashes of lines: lengths drawn and left out, in line widths; none: a solid line."""
COLOURS = ("#310DFD", "#95210B", "#57B376", "#C79B02", "#B15DFF", "#F665C3", "#86078E", "#514B52")
"""Colours that stay apart in every kind of colour blindness; :func:`lighter` of them does on a dark ground."""
TRUE, RING, DRIVE = "#0072B2", "#C28A00", "#B3508A"
"""The true crystal, the bright ring as the camera reads it, and drives; a reference is dashed, in :data:`INK`."""
DPI = 160
COLUMNS = 6
"""Largest number of controllers in the figure of a crystal: more would be too wide for a page."""
INK, GREY = "#222222", "#999999"


class Style(NamedTuple):
    """Look of a controller, the same in every figure."""

    colour: str
    mark: str
    dashes: tuple[float, ...]


def _style(colour: int, mark: str, dashes: int | None = None) -> Style:
    return Style(COLOURS[colour], mark, DASHES[colour if dashes is None else dashes])


STYLES = {
    "paper": _style(1, "circle"),
    "paper-tuned": _style(5, "square"),
    "lqg-at-0.02": _style(0, "triangle"),
    "lqg-one-design": _style(2, "flag"),
    "gradient": _style(3, "diamond"),
    "ppo": _style(4, "tall diamond"),
    "sac": _style(6, "wide diamond"),
    "ppo-plain": _style(7, "kite"),
    "compensated": _style(1, "circle"),
    "ring-pid": _style(5, "square"),
    "lqg-along": _style(0, "triangle"),
    "ring-pid-reduced": _style(2, "flag"),
    "recipe": _style(7, "pentagon"),
    "true-radius": _style(6, "cross"),
    "gradient-along": _style(3, "diamond"),
    "ppo-along": _style(4, "tall diamond"),
    "open-loop": _style(7, "pentagon", 1),
    "pid-uncompensated": _style(6, "cross", 2),
    "pid-conventional": _style(4, "bar", 0),
    "paper-filtered": _style(1, "sun", 6),  # of one family with paper
    "lqg": _style(6, "pentagon", 4),
    "lqg-quiet": _style(7, "sun", 3),
    "lqg-at-0.02-adaptive": _style(0, "cross", 4),
}
"""Looks of the controllers in the project's figures; :func:`styles` has those of others."""


def styles(names: Sequence[str], learned: Sequence[str] = ()) -> dict[str, Style]:
    """Return the look of each controller; one that has none in :data:`STYLES` gets one that none of these has.

    It depends on the name, and changes only where two would look alike; colours that no earlier name has come first.
    Those ``learned`` get marks of agents.
    """
    looks: dict[str, Style] = {}
    for name in names:
        marks = [mark for mark in MARKS if (mark in LEARNED) == (name in learned)]
        first = crc32(name.encode())
        every = [_style((first + place) % len(COLOURS), mark) for mark in marks for place in range(len(COLOURS))]
        free = [look for look in every if look not in (*STYLES.values(), *looks.values())] or every
        colours, used = ({look[place] for look in looks.values()} for place in (0, 1))
        free.sort(key=lambda look: (look.colour in colours, look.mark in used))
        looks[name] = STYLES.get(name, free[0])
    return looks


def lighter(colour: str) -> str:
    """Return a colour's tint for a dark ground."""
    parts = (int(colour[place : place + 2], 16) for place in (1, 3, 5))
    return "#" + "".join(f"{round(part + 0.35 * (255 - part)):02X}" for part in parts)


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
    colour: str
    noisy: bool = False
    """True to draw single steps pale, with their running mean on top."""


_PANELS = (
    _Panel("crystal radius [mm]", lambda s: s.r_c / MM, TRUE),
    _Panel("bright ring [mm]", lambda s: s.r_br / MM, RING),
    _Panel("pull speed [mm/min]", lambda s: s.v_p / MM_PER_MIN, DRIVE, noisy=True),
    _Panel("heater power [kW]", lambda s: s.Q_H / KILO, DRIVE, noisy=True),
    _Panel("melt temperature [K]", lambda s: s.T_b, INK),
)


class DrawnCrystal(NamedTuple):
    """A crystal under one controller."""

    title: str
    signals: Logged
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
        Line2D([], [], color=RING, lw=1.2, alpha=0.4, label="ring as the camera reports it"),
        Line2D([], [], color=DRIVE, lw=1.4, label="a drive's 5 min mean; pale: its single steps"),
    ]
    if tolerance:
        handles.insert(1, Patch(color=GREY, alpha=0.3, lw=0, label=f"diameter within ±{2.0 * tolerance / MM:g} mm"))
    figure.legend(handles=handles, loc="outside lower center", fontsize=8.5, frameon=False)
    return figure


def _draw(axes: Any, crystal: DrawnCrystal, dt: float, reference: Floats) -> None:
    signals = crystal.signals
    minutes = _minutes(len(signals.r_c), dt)
    axes[0].plot(_minutes(len(reference), dt), reference / MM, color=INK, lw=1.0, ls="--", zorder=3)
    axes[1].plot(minutes, signals.r_br_measured / MM, color=RING, lw=0.4, alpha=0.4)
    for axis, panel in zip(axes, _PANELS, strict=True):
        values = panel.value(signals)
        axis.plot(minutes, values, color=panel.colour, **({"lw": 0.4, "alpha": 0.4} if panel.noisy else {"lw": 1.1}))
        if panel.noisy:
            window = min(max(round(SMOOTH / dt), 1), len(values))
            mean = np.convolve(values, np.full(window, 1.0 / window), "valid")
            axis.plot(minutes[window - 1 :] - 0.5 * (window - 1) * dt / MINUTE, mean, color=panel.colour, lw=1.4)
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
