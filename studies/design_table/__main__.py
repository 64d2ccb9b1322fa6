"""Design table of the linear controllers: ``python -m studies.design_table --out results/design``.

Each controller is linearised from the code that runs (:mod:`cz_gym.baselines.analysis.sampled_loop`) and joined, at
its control interval, with the plant: nominal Model I, nominal Model II, and the pullers of the first validation
episodes, of which every column shows the worst. Where a scenario has settings of its own, these follow; a late camera
is part of the loop.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cz_gym.atomic_files import check_writable, write_files
from cz_gym.baselines.analysis.frequency import crossover, loop_margins, peak
from cz_gym.baselines.analysis.linear_form import linear_form
from cz_gym.baselines.analysis.sampled_loop import Loop, NotLinearError, close, late, root_mean_square
from cz_gym.baselines.bounds.future import pullers_of
from cz_gym.baselines.registry import CONTROLLERS, find_controller
from cz_gym.commands import OneLineParser, guarded
from cz_gym.config import Config, make_config
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.physics.linearisation import StateSpace, radius_model
from cz_gym.physics.plant import Puller, make_puller
from cz_gym.units import KILO, MM, MM_PER_MIN

FAST, SLOW = 30.0, 780.0
"""Correlation times of the interface's fluctuations [s]."""
USUAL, OTHERS = "randomized", ("puller", "sensor-fault")
"""The scenario whose settings come first, and those with settings of their own."""


class Row(NamedTuple):
    """One controller on one plant, or the worst over several; NaN where the loop is unstable."""

    controller: str
    plant: str
    stable: float
    """Share of the plants on which the closed loop is stable [-]."""
    crossover: float
    """Loop opened at the camera [rad/s]."""
    crossover_over_zero: float
    """The same over the plant's right-half-plane zero [-]; without compensator it should be at most 0.5."""
    crossover_compensated: float
    """Loop opened at the pull speed, the compensator counted as plant, as the paper does [rad/s]."""
    gain_up: float
    """Factor by which the plant's gain may grow [-]."""
    gain_down: float
    """Factor by which it may fall [-]."""
    phase_deg: float
    """Phase margin [degrees]."""
    delay: float
    """Delay margin [s]."""
    sensitivity: float
    """Peak of the sensitivity function [-]."""
    noise_gain: float
    """Pull speed RMS per white camera noise RMS [mm/min per mm]."""
    noise_step_gain: float
    """Pull speed step RMS per white camera noise RMS [mm/min per mm]."""
    fast_fluctuation: float
    """Radius RMS per RMS of a 30 s fluctuation of the interface temperature [mm/K]."""
    slow_fluctuation: float
    """The same for 780 s [mm/K]."""
    load_peak: float
    """Largest gain over frequency from the melt's heat load to the radius [mm/kW]."""


_MOST = ("crossover", "crossover_over_zero", "crossover_compensated", "gain_down", "sensitivity", "noise_gain",
         "noise_step_gain", "fast_fluctuation", "slow_fluctuation", "load_peak")  # fmt: skip
"""Columns whose worst is the largest; of the others it is the smallest."""


def random_pullers(config: Config, count: int) -> list[Puller]:
    """The pullers of the first validation episodes of a scenario."""
    return list(pullers_of(config, VALIDATION_SEEDS[:count]))


def judge(name: str, plant: str, controller: StateSpace, free: StateSpace, puller: Puller, dt: float) -> Row:
    """One row; ``free`` is the controller without the anti-windup that would fight an opened loop."""
    margins, loop = loop_margins(controller, puller, dt), close(controller, puller, dt)
    return Row(
        name,
        plant,
        float(loop.stable),
        margins.crossover,
        margins.crossover / radius_model(puller).zero,
        crossover(free, puller, dt, "v_p"),
        *margins[1:],
        root_mean_square(loop.pick("v_p", ("camera",))) / (MM_PER_MIN / MM),
        root_mean_square(loop.pick("v_p", ("camera",)), difference=True) / (MM_PER_MIN / MM),
        root_mean_square(coloured(loop, FAST)) / MM,
        root_mean_square(coloured(loop, SLOW)) / MM,
        peak(loop, "r_c", "Q_d") * KILO / MM if loop.stable else math.nan,
    )


def coloured(loop: Loop, tau: float) -> StateSpace:
    """Radius from the white noise behind an interface fluctuation of unit variance and correlation time tau [s]."""
    A, B, C, D = loop.pick("r_c", ("dT_i",))
    keep, n = math.exp(-loop.dt / tau), len(A)
    kick = math.sqrt(1.0 - keep * keep)
    joined = np.block([[A, B], [np.zeros((1, n)), np.array([[keep]])]])
    return StateSpace(joined, np.vstack([np.zeros((n, 1)), [[kick]]]), np.hstack([C, D]), np.zeros((1, 1)))


def worst(rows: Sequence[Row], plant: str) -> Row:
    """The worst of each column; stable becomes the share."""
    columns: dict[str, Any] = {"controller": rows[0].controller, "plant": plant}
    for name in Row._fields[2:]:
        values = np.array([getattr(row, name) for row in rows])
        found = values[np.isfinite(values)]
        pick = np.mean if name == "stable" else np.max if name in _MOST else np.min
        columns[name] = float(pick(found)) if len(found) else math.nan
    return Row(**columns)


def table(names: Sequence[str], pullers: int, others: Sequence[str] = OTHERS) -> tuple[list[Row], list[str]]:
    """Rows of the named controllers, and one line for each that has no linear form.

    First on ``randomized``; then on those of the ``others`` for which a controller has settings of its own.
    """
    rows: list[Row] = []
    skipped: list[str] = []
    for name in names:
        make = find_controller(name).make
        try:
            rows += _rows(name, make(make_config(USUAL)), make_config(USUAL), pullers)
        except NotLinearError as error:
            skipped.append(f"{name}: {error}")
            continue
        for other in others:
            config = make_config(other)
            if make(config) != make(make_config(USUAL)):
                rows += _rows(f"{name} on {other}", make(config), config, pullers)
    return rows, skipped


def _rows(name: str, policy: Any, config: Config, pullers: int) -> list[Row]:
    """Models I and II, and the worst of the scenario's first pullers."""
    form = linear_form(policy)
    behind = round(config.scenario.sensor.latency / form.dt)
    controller, free = late(form.controller, behind), late(form.free, behind)
    rows = []
    for label, lam in (("Model I", 1.0), ("Model II", 0.0)):
        puller = make_puller(config.parameters, lam, config.meniscus)
        rows.append(judge(name, label, controller, free, puller, form.dt))
    many = [judge(name, "", controller, free, puller, form.dt) for puller in random_pullers(config, pullers)]
    return [*rows, worst(many, f"worst of {pullers}")]


def as_markdown(rows: Sequence[Row], skipped: Sequence[str]) -> str:
    """The table for people, with what each column means."""
    heads = [name.replace("_", " ") for name in Row._fields]
    lines = ["# Design of the linear controllers", "", "| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for row in rows:
        numbers = ("-" if math.isnan(value) else f"{value:.3g}" for value in row[2:])
        lines.append("| " + " | ".join([row.controller, row.plant, *numbers]) + " |")
    lines += ["", *(f"- **{head}**: {_MEANING[name]}" for head, name in zip(heads, Row._fields, strict=True))]
    return "\n".join([*lines, "", *(f"No linear form: {line}." for line in skipped)]).rstrip() + "\n"


_MEANING = {
    "controller": "name in the benchmark; with a scenario, its settings there and that camera's latency in the loop",
    "plant": "nominal puller, or the worst of each column over the pullers of the first validation episodes",
    "stable": "share of the plants on which the closed loop is stable",
    "crossover": "where the loop gain falls through one, loop opened at the camera [rad/s]",
    "crossover_over_zero": "the same over the right-half-plane zero of the ring measurement",
    "crossover_compensated": "loop opened at the pull speed, so that a compensator counts as plant [rad/s]",
    "gain_up": "factor by which the plant's gain may grow",
    "gain_down": "factor by which it may fall",
    "phase_deg": "least phase margin at the camera [degrees]",
    "delay": "least delay of the camera, beyond its own, that destabilises [s]",
    "sensitivity": "peak of the sensitivity function",
    "noise_gain": "pull speed RMS per white camera noise RMS [mm/min per mm]",
    "noise_step_gain": "pull speed step RMS per white camera noise RMS [mm/min per mm]",
    "fast_fluctuation": "radius RMS per RMS of a 30 s interface fluctuation [mm/K]",
    "slow_fluctuation": "the same for 780 s [mm/K]",
    "load_peak": "largest gain over frequency from heat load to radius [mm/kW]",
}


def as_csv(rows: Sequence[Row]) -> str:
    """The rows as CSV, unstable loops empty."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(Row._fields)
    for row in rows:
        writer.writerow([*row[:2], *("" if math.isnan(value) else f"{value:.6g}" for value in row[2:])])
    return out.getvalue()


def as_json(rows: Sequence[Row], skipped: Sequence[str]) -> str:
    """Rows and skipped controllers as JSON, unstable loops null."""
    plain = [
        {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in row._asdict().items()} for row in rows
    ]
    return json.dumps({"rows": plain, "no_linear_form": list(skipped)}, indent=2) + "\n"


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser(prog="python -m studies.design_table", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--controllers", nargs="+", help="names; by default those that the benchmark runs by default")
    parser.add_argument("--pullers", type=int, default=50, help="random pullers for the worst case, at most 500")
    parser.add_argument("--out", type=Path, default=Path("results/design"), help="folder of design.md, .csv and .json")
    args = parser.parse_args(arguments)
    return guarded(parser.prog, lambda: _tabulate(args), "benchmark")


def _tabulate(args: argparse.Namespace) -> int:
    if not 1 <= args.pullers <= 500:
        raise ValueError(f"--pullers must be between 1 and 500, not {args.pullers}")
    check_writable(args.out)
    names = args.controllers or [entry.name for entry in CONTROLLERS if entry.default]
    rows, skipped = table(names, args.pullers)
    text = as_markdown(rows, skipped)
    contents = {"design.md": text, "design.csv": as_csv(rows), "design.json": as_json(rows, skipped)}
    write_files({args.out / name: content.encode() for name, content in contents.items()})
    print(text, end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
