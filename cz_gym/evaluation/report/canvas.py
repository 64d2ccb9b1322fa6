"""What the figures share: how each controller is drawn, a canvas without a display, PNG bytes."""

from __future__ import annotations

import io
from collections.abc import Sequence
from itertools import chain, count
from typing import IO, NamedTuple

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from cz_gym.evaluation.results import REFERENCE, Controller, Sample

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
"""Matplotlib's markers and plotly's names of them."""
DASHES = ("solid", "dash", "dot")
"""Plotly's lines: the next one where the colours begin again."""
DPI = 160
INK, GREY = "#222222", "#999999"
KNOWN = ("ppo", "gradient", "lqg-at-0.02", "paper", "paper-tuned")
"""Controllers of README's table, which figures prefer."""
ORDER = (
    *KNOWN, "lqg", "lqg-quiet", "imitation", "sac", "industrial",
    "pid-conventional", "paper-filtered", "open-loop", "pid-uncompensated",
)  # fmt: skip
"""What runs by default: each looks the same in every figure of every run, by its place here."""


class Style(NamedTuple):
    """How a controller is drawn, the same in every figure."""

    colour: str
    marker: str
    dash: str


def styles(names: Sequence[str]) -> dict[str, Style]:
    """One style a controller: that of its place in :data:`ORDER`, or in turn one that no other here has."""
    markers, absent = list(MARKERS), [i for i, name in enumerate(ORDER) if name not in names]
    free = chain(range(len(ORDER), len(COLOURS)), absent, count(len(COLOURS)))
    places = {name: ORDER.index(name) if name in ORDER else next(free) for name in names}
    return {
        name: Style(COLOURS[i % len(COLOURS)], markers[i % len(markers)], DASHES[i // len(COLOURS) % len(DASHES)])
        for name, i in places.items()
    }


def styles_of(controllers: Sequence[Controller]) -> dict[str, Style]:
    """One style a controller; after the known ones come the user's own, then the learned."""
    return styles([each.name for each in sorted(controllers, key=lambda each: (not each.own, not each.learned))])


def chosen(samples: Sequence[Sample], most: int) -> list[Sample]:
    """At most so many of them, in their order, for a figure that has no room for all.

    The reference, the user's own, the known ones, the best learned one, then the others; bounds last. Among equals the
    lowest mean RMSE comes first.
    """
    ranked = sorted(samples, key=lambda sample: float(sample.metric("rmse_mm").mean()))
    learned = [sample.controller.name for sample in ranked if sample.controller.learned]

    def place(sample: Sample) -> tuple[bool, ...]:
        who = sample.controller
        return who.name != REFERENCE, not who.own, who.name not in KNOWN, who.name not in learned[:1], who.bound

    names = [sample.controller.name for sample in sorted(ranked, key=place)[:most]]
    return [sample for sample in samples if sample.controller.name in names]


def canvas(width: float, height: float) -> Figure:
    """A figure of that size [in]."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def png(figure: Figure) -> bytes:
    """The figure as a PNG file, its axes in the house's style."""
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
    return small(image)


def small(image: IO[bytes]) -> bytes:
    """A PNG of at most 256 colours, a third of the size of one that has them all: figures have few."""
    palette = Image.open(image).convert("RGB").quantize(256, dither=Image.Dither.NONE)
    packed = io.BytesIO()
    palette.save(packed, format="png", optimize=True)
    return packed.getvalue()
