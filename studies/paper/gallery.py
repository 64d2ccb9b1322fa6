"""The report's figures: their files, their captions and who draws them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from . import diagrams, figures
from . import extra_figures as extras
from .numbers import Results


class Figure(NamedTuple):
    """A figure of the report."""

    file: str
    caption: str
    draw: Callable[[Results], Any]


FIGURES = (
    Figure("figure_01_pull_profile.png", "Paper's figure 1: pull speed.", figures.pull_profile),
    Figure(
        "figure_02_open_loop_I.png", "Paper's figure 2: plant at constant power, Model I.",
        lambda r: figures.open_loop_response(r, "I"),
    ),
    Figure(
        "figure_03_open_loop_II.png", "Paper's figure 3: plant at constant power, Model II.",
        lambda r: figures.open_loop_response(r, "II"),
    ),
    Figure("figure_04_series.png", "Paper's figure 4: plant and measurement.", lambda r: diagrams.series_connection()),
    Figure("figure_05_feedback.png", "Paper's figure 5: feedback.", lambda r: diagrams.feedback()),
    Figure(
        "figure_06_bode_sketch.png",
        "Paper's figure 6, there a sketch, here the uncompensated plant: the PID's crossover lies beyond the zero.",
        figures.margin_sketch,
    ),
    Figure("figure_07_parallel.png", "Paper's figure 7: parallel compensation.", lambda r: diagrams.parallel()),
    Figure("figure_08_loop.png", "Paper's figure 8: the linear loop.", lambda r: diagrams.compensated_loop()),
    Figure("figure_09_bode.png", "Paper's figure 9: compensated loops.", figures.frequency_responses),
    Figure("figure_10_tested_loop.png", "Paper's figure 10: the loop on the plant.", lambda r: diagrams.tested_loop()),
    Figure("figure_11_cases.png", "Paper's figure 11: cases A and B.", figures.case_comparison),
    Figure(
        "figure_12_temperatures.png",
        "Paper's figure 12: temperatures; Model II's are identical, as the thermal chain does not depend on it.",
        figures.ramp_temperatures,
    ),
    Figure("figure_13_ramp_I.png", "Paper's figure 13: the ramp, Model I.", lambda r: figures.ramp_response(r, "I")),
    Figure("figure_14_ramp_II.png", "Paper's figure 14: the ramp, Model II.", lambda r: figures.ramp_response(r, "II")),
    Figure("extra_a_linear_steps.png", "Steps of plant and linear model, per per cent.", extras.linear_steps),
    Figure("extra_b_washout.png", "True radius against compensated measurement.", extras.true_against_compensated),
    Figure("extra_c_cut_off.png", "The ramp against the high-pass cut-off.", extras.cut_off_sweep),
    Figure("extra_d_noise.png", "Camera noise in the pull speed, one hour, Model I.", extras.noise_sweep),
    Figure("extra_e_meniscus.png", "Hurle against the exact meniscus.", extras.menisci),
)  # fmt: skip
