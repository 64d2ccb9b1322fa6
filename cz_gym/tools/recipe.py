"""``cz-gym recipe``: the set points of a whole crystal against its length, as an operator loads them."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

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

ROWS_PRINTED = 16
PRINTED = {
    "length mm": "length_mm", "time h": "time_h", "radius mm": "radius_mm", "cone deg": "cone_angle_deg",
    "pull mm/min": "pull_speed_mm_per_min", "heater kW": "heater_power_kW", "T_1 K": "T_1_K",
    "superheat K": "superheat_K", "meniscus mm": "meniscus_height_mm", "mass kg": "crystal_mass_kg",
}  # fmt: skip
"""Columns of the table that are printed, by their headings."""


def recipe_table(puller: PullerFile) -> Any:
    """Tabulate a puller's recipe against length in a pandas DataFrame, in the units that its columns name.

    Raises CzError, with the length, for what cannot be grown.
    """
    import pandas

    config = make_config(process=CRYSTAL, puller=puller, stage="whole")
    p, table = nominal_recipe(config.parameters._replace(**dict.fromkeys(CRYSTAL.apart, 0.0)), config.meniscus)
    at, L = recipe.RecipeRow(*table.T), lengths(p)
    r, slope, v_g = (np.array(column) for column in zip(*(shape_at(each, p, Episode()) for each in L), strict=True))
    level = (p.M_0 - at.M_s - at.M_men) / (p.rho_l * np.pi * p.R_cr**2)
    columns = {
        "length_mm": L / MM,
        "time_min": (at.t - at.t[recipe.MARGIN]) / MINUTE,
        "radius_mm": r / MM,
        "cone_angle_deg": np.degrees(np.arctan(slope)).round(9) + 0.0,
        "growth_rate_mm_per_min": v_g / MM_PER_MIN,
        "pull_speed_mm_per_min": at.v_p / MM_PER_MIN,
        "heater_power_kW": at.Q_H / KILO,
        "T_1_K": at.T_1,
        "superheat_K": at.T_b - p.T_m,
        "meniscus_height_mm": at.h_c / MM,
        "ring_radius_mm": (r + at.ring) / MM,
        "crystal_mass_kg": at.M_s,
        "crucible_lift_mm_per_min": -np.gradient(level, at.t) / MM_PER_MIN,
    }
    return pandas.DataFrame(columns)[recipe.MARGIN : recipe.ROWS - recipe.MARGIN]


def draw(rows: Any, title: str) -> bytes:
    """Draw the rows of a recipe: the crystal's outline, then drives and temperatures, as PNG."""
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
    rows = recipe_table(puller)
    text = rows.to_csv(index=False, float_format="%.6g", lineterminator="\n")
    files = {given.out / "recipe.csv": text.encode(), given.out / "recipe.png": draw(rows, puller.label)}
    write_files(files)
    printed = rows.assign(time_h=rows.time_min / 60.0)[list(PRINTED.values())]
    print(" ".join(f"{heading:>11}" for heading in PRINTED))
    for i in np.linspace(0, len(rows) - 1, ROWS_PRINTED).round().astype(int):
        print(" ".join(f"{value:>11.4g}" for value in printed.iloc[i]))
    print("wrote", ", ".join(relative_path(path) for path in files))
