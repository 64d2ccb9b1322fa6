"""Parts of every figure: the style of each controller, a canvas without a display, PNG bytes."""

import io
from collections.abc import Sequence
from itertools import cycle
from typing import NamedTuple

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from cz_gym.evaluation.results import REFERENCE, Sample

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


def styles_of(samples: Sequence[Sample]) -> dict[str, Style]:
    """Return one style a contender: the user's own come first, then the quoted, agents, and the others."""
    contenders = [sample.contender for sample in samples]
    return styles([each.name for each in sorted(contenders, key=lambda c: (not c.own, not c.quoted, not c.learned))])


def chosen(samples: Sequence[Sample], most: int) -> list[Sample]:
    """Return at most ``most`` of the samples, in their order, for a figure that has no room for all.

    Preferred are the reference, the user's own, the best agent, quoted controllers, other agents, other controllers,
    bounds; within a group those of a lower mean RMSE.
    """
    ranked = sorted(samples, key=lambda sample: float(sample.metric("rmse_mm").mean()))
    learned = [sample.name for sample in ranked if sample.contender.learned and not sample.contender.bound]

    def place(sample: Sample) -> tuple[bool, ...]:
        who = sample.contender
        first = who.name != REFERENCE, not who.own, who.name not in learned[:1], not who.quoted
        return *first, who.bound, not who.learned

    names = [sample.name for sample in sorted(ranked, key=place)[:most]]
    return [sample for sample in samples if sample.name in names]


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
