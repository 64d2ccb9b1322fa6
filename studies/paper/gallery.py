"""The report's figures: their files, their captions and who draws them; block diagrams are kept as pictures."""

from __future__ import annotations

import io
from collections.abc import Callable
from functools import partial
from pathlib import Path
from textwrap import fill
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from cz_gym.evaluation.report.canvas import small

from . import beyond_figures, figures

DIAGRAMS = Path(__file__).parent / "diagrams"
DPI = 160
"""Resolution of the figures [dots per inch]."""
ABOVE = 0.3
"""Room for a block diagram's title [in]."""


class Shown(NamedTuple):
    """A figure of the report."""

    file: str
    caption: str
    draw: Callable[[], Figure] | None
    """None for a block diagram, which is a file."""

    def png(self) -> bytes:
        """The figure as a PNG file."""
        image = io.BytesIO()
        figure = self.draw() if self.draw else _diagram(DIAGRAMS / self.file)
        figure.suptitle(fill(self.caption.removesuffix("."), round(13.0 * figure.get_figwidth())), fontsize=10)
        figure.savefig(image, dpi=DPI, format="png")
        return small(image)


def _diagram(path: Path) -> Figure:
    """A picture with room for a title above it."""
    with Image.open(path) as picture:
        figure = Figure(figsize=(picture.width / DPI, picture.height / DPI + ABOVE), dpi=DPI)
        figure.figimage(np.asarray(picture))
    return figure


FIGURES = tuple(
    Shown(f"{file}.png", caption, draw)
    for file, caption, draw in (
        ("figure_01_pull_profile", "Paper's figure 1: pull speed.", figures.pull_profile),
        ("figure_02_open_loop_I", "Paper's figure 2: plant at constant power, Model I.",
         partial(figures.open_loop_response, model="I")),
        ("figure_03_open_loop_II", "Paper's figure 3: plant at constant power, Model II.",
         partial(figures.open_loop_response, model="II")),
        ("figure_04_series", "Paper's figure 4: plant and measurement.", None),
        ("figure_05_feedback", "Paper's figure 5: feedback.", None),
        ("figure_06_bode_sketch",
         "Paper's figure 6, there a sketch, here the uncompensated plant: the PID's crossover lies beyond the zero.",
         figures.margin_sketch),
        ("figure_07_parallel", "Paper's figure 7: parallel compensation.", None),
        ("figure_08_loop", "Paper's figure 8: the linear loop.", None),
        ("figure_09_bode", "Paper's figure 9: compensated loops.", figures.frequency_responses),
        ("figure_10_tested_loop", "Paper's figure 10: the loop on the plant.", None),
        ("figure_11_cases", "Paper's figure 11: cases A and B.", figures.case_comparison),
        ("figure_12_temperatures",
         "Paper's figure 12: temperatures; Model II's are identical, as the thermal chain does not depend on it.",
         figures.ramp_temperatures),
        ("figure_13_ramp_I", "Paper's figure 13: the ramp, Model I.", partial(figures.ramp_response, model="I")),
        ("figure_14_ramp_II", "Paper's figure 14: the ramp, Model II.", partial(figures.ramp_response, model="II")),
        ("extra_a_linear_steps", "Steps of the pull speed: plant against linear model.", beyond_figures.linear_steps),
        ("extra_b_washout", "The ramp: true radius against compensated measurement.", beyond_figures.washout),
        ("extra_c_cut_off", "The ramp: error and margin against the high-pass cut-off.", beyond_figures.cut_off_sweep),
        ("extra_d_noise", "Camera noise in the pull speed: one hour, Model I.", beyond_figures.noise_sweep),
        ("extra_e_meniscus", "Hurle against the exact meniscus.", beyond_figures.menisci),
    )
)  # fmt: skip
