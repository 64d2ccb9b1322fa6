"""Design table of the linear controllers: ``python -m studies.design_table --out results/design``.

Each controller is linearised from the code that runs (:mod:`cz_gym.baselines.analysis.sampled_loop`) and joined with
the nominal plants and with the pullers of the first validation episodes, of which every column shows the worst.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cz_gym.atomic_files import check_writable, write_files
from cz_gym.baselines.analysis.frequency import crossover, loop_margins, peak
from cz_gym.baselines.analysis.linear_form import linear_form
from cz_gym.baselines.analysis.sampled_loop import Loop, NotLinearError, close, late, root_mean_square
from cz_gym.baselines.bounds.future import pullers_of
from cz_gym.baselines.registry import CONTROLLERS, find_controller
from cz_gym.commands import OneLineParser, between
from cz_gym.config import Config, make_config
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.evaluation.report.tables import markdown
from cz_gym.physics.linearisation import StateSpace, radius_model
from cz_gym.physics.plant import Puller, make_puller
from cz_gym.units import KILO, MM, MM_PER_MIN

FAST, SLOW = 30.0, 780.0
"""Correlation times of the interface's fluctuations [s]."""
DEFAULT_SCENARIO, OTHERS = "randomized", ("puller", "sensor-fault")
"""The scenario whose settings come first, and those with settings of their own."""


class Column(NamedTuple):
    """One figure of a loop."""

    meaning: str
    worst: Callable[[Any], Any] = np.max
    """What takes the place of one plant's figure over many plants."""


COLUMNS = {
    "stable": Column("share of the plants on which the closed loop is stable", np.mean),
    "crossover": Column("where the loop gain falls through one, loop opened at the camera [rad/s]"),
    "crossover_over_zero": Column("the same over the right-half-plane zero of the ring measurement"),
    "crossover_compensated": Column("loop opened at the pull speed, so that a compensator counts as plant [rad/s]"),
    "gain_up": Column("factor by which the plant's gain may grow", np.min),
    "gain_down": Column("factor by which it may fall"),
    "phase_deg": Column("least phase margin at the camera [degrees]", np.min),
    "delay": Column("least delay of the camera, beyond its own, that destabilises [s]", np.min),
    "sensitivity": Column("peak of the sensitivity function"),
    "noise_gain": Column("pull speed RMS per white camera noise RMS [mm/min per mm]"),
    "noise_step_gain": Column("pull speed step RMS per white camera noise RMS [mm/min per mm]"),
    "fast_fluctuation": Column("radius RMS per RMS of a 30 s interface fluctuation [mm/K]"),
    "slow_fluctuation": Column("the same for 780 s [mm/K]"),
    "load_peak": Column("largest gain over frequency from heat load to radius [mm/kW]"),
}


class Row(NamedTuple):
    """One controller on one plant, or the worst over several."""

    controller: str
    plant: str
    figures: dict[str, float]
    """By column; NaN where the loop is unstable or a margin has no bound."""


def judge(name: str, plant: str, controller: StateSpace, free: StateSpace, puller: Puller, dt: float) -> Row:
    """One row; ``free`` is the controller without the anti-windup that would fight an opened loop."""
    margins, loop = loop_margins(controller, puller, dt), close(controller, puller, dt)
    pull = loop.pick("v_p", ("camera",))
    figures = (
        float(loop.stable),
        margins.crossover,
        margins.crossover / radius_model(puller).zero,
        crossover(free, puller, dt, "v_p"),
        *margins[1:],
        root_mean_square(pull) / (MM_PER_MIN / MM),
        root_mean_square(pull, difference=True) / (MM_PER_MIN / MM),
        root_mean_square(coloured(loop, FAST)) / MM,
        root_mean_square(coloured(loop, SLOW)) / MM,
        peak(loop, "r_c", "Q_d") * KILO / MM if loop.stable else math.nan,
    )
    return Row(name, plant, dict(zip(COLUMNS, figures, strict=True)))


def coloured(loop: Loop, tau: float) -> StateSpace:
    """Radius from the white noise behind an interface fluctuation of unit variance and correlation time tau [s]."""
    A, B, C, D = loop.pick("r_c", ("dT_i",))
    keep, n = math.exp(-loop.dt / tau), len(A)
    kick = math.sqrt(1.0 - keep * keep)
    joined = np.block([[A, B], [np.zeros((1, n)), np.array([[keep]])]])
    return StateSpace(joined, np.vstack([np.zeros((n, 1)), [[kick]]]), np.hstack([C, D]), np.zeros((1, 1)))


def worst(rows: Sequence[Row], plant: str) -> Row:
    """The worst of each column; stable becomes the share."""
    figures = {}
    for name, column in COLUMNS.items():
        finite = [row.figures[name] for row in rows if math.isfinite(row.figures[name])]
        figures[name] = float(column.worst(finite)) if finite else math.nan
    return Row(rows[0].controller, plant, figures)


def table(names: Sequence[str], pullers: int, others: Sequence[str] = OTHERS) -> tuple[list[Row], list[str]]:
    """Rows of the named controllers, and one line for each that has no linear form.

    First on ``randomized``; then on those of the ``others`` for which a controller has settings of its own.
    """
    rows: list[Row] = []
    skipped: list[str] = []
    default = make_config(DEFAULT_SCENARIO)
    for name in names:
        make = find_controller(name).make
        try:
            rows += _rows(name, make(default), default, pullers)
        except NotLinearError as error:
            skipped.append(f"{name}: {error}")
            continue
        for other in others:
            config = make_config(other)
            if make(config) != make(default):
                rows += _rows(f"{name} on {other}", make(config), config, pullers)
    return rows, skipped


def _rows(name: str, policy: Any, config: Config, pullers: int) -> list[Row]:
    """Models I and II, and the worst of the scenario's first pullers."""
    form = linear_form(policy)
    behind = round(config.scenario.sensor.latency / form.dt)
    controller, free = late(form.controller, behind), late(form.free, behind)
    plants = [
        (f"Model {n}", make_puller(config.parameters, lam, config.meniscus)) for n, lam in (("I", 1.0), ("II", 0.0))
    ]
    plants += [("", puller) for puller in pullers_of(config, VALIDATION_SEEDS[:pullers])]
    rows = [judge(name, plant, controller, free, puller, form.dt) for plant, puller in plants]
    return [*rows[:2], worst(rows[2:], f"worst of {pullers}")]


def as_markdown(rows: Sequence[Row], skipped: Sequence[str]) -> str:
    """The table for people, with what each column means."""
    meanings = {
        "controller": "name in the benchmark; with a scenario, its settings there and that camera's latency "
        "in the loop",
        "plant": "nominal puller, or the worst of each column over the pullers of the first validation episodes",
        **{name.replace("_", " "): column.meaning for name, column in COLUMNS.items()},
    }
    lines = [
        (controller, plant, *("-" if math.isnan(value) else f"{value:.3g}" for value in figures.values()))
        for controller, plant, figures in rows
    ]
    parts = ["# Design of the linear controllers", "", markdown(meanings, lines, "---"), ""]
    parts += [f"- **{head}**: {meaning}" for head, meaning in meanings.items()]
    return "\n".join([*parts, "", *(f"No linear form: {line}." for line in skipped)]).rstrip() + "\n"


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser(prog="python -m studies.design_table", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--controllers", nargs="+", help="names; by default those that the benchmark runs by default")
    most = len(VALIDATION_SEEDS)
    parser.add_argument(
        "--pullers", type=between(1, most), default=50, help=f"random pullers for the worst case, at most {most}"
    )
    parser.add_argument("--out", type=Path, default=Path("results/design"), help="folder of design.md")
    return parser.run(_tabulate, arguments, "benchmark")


def _tabulate(args: argparse.Namespace) -> None:
    check_writable(args.out)
    names = args.controllers or [entry.name for entry in CONTROLLERS if entry.default]
    rows, skipped = table(names, args.pullers)
    text = as_markdown(rows, skipped)
    write_files({args.out / "design.md": text.encode()})
    print(text, end="")


if __name__ == "__main__":
    sys.exit(main())
