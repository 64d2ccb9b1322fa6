"""``cz-gym recipe``: the set points of a whole crystal against its length, what an operator loads."""

import argparse
import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cz_gym.config import make_config
from cz_gym.crystal import recipe
from cz_gym.crystal.process import CRYSTAL, lengths, nominal_recipe
from cz_gym.crystal.recipe import shape_at
from cz_gym.episodes.draw import Episode
from cz_gym.puller.file import PullerFile, chosen_puller
from cz_gym.support.command_line import OneLineParser, relative_path
from cz_gym.support.files import write_files
from cz_gym.support.units import KILO, MINUTE, MM, MM_PER_MIN

_PRINTED = 16


class SetPoints(NamedTuple):
    """The set points at a length, in the units that people read; arrays along the crystal."""

    length_mm: Any
    time_min: Any
    radius_mm: Any
    cone_angle_deg: Any
    growth_rate_mm_per_min: Any
    pull_speed_mm_per_min: Any
    heater_power_kW: Any
    T_1_K: Any
    superheat_K: Any
    meniscus_height_mm: Any
    ring_radius_mm: Any
    crystal_mass_kg: Any
    crucible_lift_mm_per_min: Any


def set_points(puller: PullerFile) -> SetPoints:
    """The recipe of a puller, a value a row of its table; CzError, with the length, for what cannot be grown."""
    config = make_config(process=CRYSTAL, puller=puller, stage="whole")
    p, table = nominal_recipe(config.parameters._replace(**dict.fromkeys(CRYSTAL.apart, 0.0)), config.meniscus)
    at, L = recipe.RecipeRow(*table.T), lengths(p)
    inside = slice(recipe.MARGIN, recipe.ROWS - recipe.MARGIN)
    r, slope, v_g = (np.array(column) for column in zip(*(shape_at(each, p, Episode()) for each in L), strict=True))
    level = (p.M_0 - at.M_s - at.M_men) / (p.rho_l * np.pi * p.R_cr**2)
    columns = SetPoints(
        L / MM, (at.t - at.t[recipe.MARGIN]) / MINUTE, r / MM,
        np.degrees(np.arctan(slope)).round(9) + 0.0, v_g / MM_PER_MIN,
        at.v_p / MM_PER_MIN, at.Q_H / KILO, at.T_1, at.T_b - p.T_m, at.h_c / MM, (r + at.ring) / MM, at.M_s,
        -np.gradient(level, at.t) / MM_PER_MIN,
    )  # fmt: skip
    return SetPoints(*(column[inside] for column in columns))


def to_csv(rows: SetPoints) -> str:
    """The set points as comma-separated values, one line a length."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(SetPoints._fields)
    writer.writerows([f"{value:.6g}" for value in row] for row in zip(*rows, strict=True))
    return text.getvalue()


def draw(rows: SetPoints, title: str) -> bytes:
    """Picture of the set points: the crystal's outline, then drives and temperatures, as PNG."""
    from cz_gym.evaluation.plots import canvas, png

    figure = canvas(8.0, 7.0)
    shape, speed, power, heat = figure.subplots(4, 1, sharex=True, height_ratios=(0.7, 1, 1, 1))
    shape.fill_between(rows.length_mm, -rows.radius_mm, rows.radius_mm, color="0.8")
    shape.set(ylabel="radius [mm]", title=title)
    speed.plot(rows.length_mm, rows.growth_rate_mm_per_min, "--", label="growth rate")
    speed.plot(rows.length_mm, rows.pull_speed_mm_per_min, label="pull speed")
    speed.set(ylabel="speed [mm/min]")
    speed.legend(frameon=False, ncols=2)
    power.plot(rows.length_mm, rows.heater_power_kW)
    power.set(ylabel="heater [kW]")
    heat.plot(rows.length_mm, rows.T_1_K)
    heat.set(ylabel="heater $T_1$ [K]", xlabel="length [mm]")
    return png(figure)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser("cz-gym recipe", "Print a whole crystal's recipe and write it as a table and a picture.")
    parser.add_argument("puller", metavar="PULLER", nargs="?", help="puller file, or the name of a shipped one")
    about = "folder for recipe.csv and recipe.png (%(default)s)"
    parser.add_argument("--out", type=Path, metavar="DIR", default=Path("recipe"), help=about)
    return parser.run(_main, arguments, "benchmark")


def _main(given: argparse.Namespace) -> None:
    puller = chosen_puller(given.puller)
    rows = set_points(puller)
    every = np.linspace(0, len(rows.length_mm) - 1, _PRINTED).round().astype(int)
    headed = {
        "length mm": rows.length_mm, "time h": rows.time_min / 60.0, "radius mm": rows.radius_mm,
        "cone deg": rows.cone_angle_deg, "pull mm/min": rows.pull_speed_mm_per_min, "heater kW": rows.heater_power_kW,
        "T_1 K": rows.T_1_K, "superheat K": rows.superheat_K, "meniscus mm": rows.meniscus_height_mm,
        "mass kg": rows.crystal_mass_kg,
    }  # fmt: skip
    files = {given.out / "recipe.csv": to_csv(rows).encode(), given.out / "recipe.png": draw(rows, puller.label)}
    write_files(files)
    print(" ".join(f"{heading:>11}" for heading in headed))
    for i in every:
        print(" ".join(f"{column[i]:>11.4g}" for column in headed.values()))
    print("wrote", ", ".join(relative_path(path) for path in files))
