"""Pullers that nobody knows, each identified from a log of three hours: ``python -m studies.identify``.

Their diameters are uniform from 100 to 300 mm. The start file has the right geometry and pull speed, a hot zone scaled
with the crystal's area and a size of its own, and handbook values of the melt. The truth's hot zone is off by a factor
of lognormal distribution, as the prior says. Each log is made under a PID of the puller's own, with and without
excitation. Three LQGs of one design then run on the same crystals: told the truth, the identified file, the start.
"""

import argparse
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cz_gym import CzEnv, Parameters, make_puller
from cz_gym.baselines.lqg import LQG
from cz_gym.baselines.pid import FilteredPID
from cz_gym.baselines.tuned_controllers import FILTER, LQGS, PIDS
from cz_gym.config import make_config
from cz_gym.episodes.scenario import Pullers
from cz_gym.episodes.scenarios import RANDOMIZED
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.evaluation.rollout import rollout
from cz_gym.puller.file import PullerFile, read_puller, write_puller
from cz_gym.spaces import HEATER_RANGE
from cz_gym.support.files import write_files
from cz_gym.support.units import KILO, MM, PERCENT
from cz_gym.tools.identify import Excited, Identified, identify, read_log, record_log
from cz_gym.tools.identify.estimate import PRIOR_SD
from cz_gym.tools.identify.moves import measure_excitation
from cz_gym.tools.report.tables import markdown

from . import StudyParser

PULLERS, CRYSTALS = 20, 20
"""Number of pullers, and of crystals of each."""
HOT_ZONE, MELT = ("C_1", "C_2", "C_b", "kappa_12", "G_1a", "G_2b", "eps"), ("sigma", "k_l")
"""Parameters of the start file that are off by PRIOR_SD, and by MELT_SD."""
MELT_SD = 0.1
"""Standard deviation of the logarithm of the melt's numbers in handbooks [-]."""
ONE = Pullers(RANDOMIZED.pullers.mix, start_radius_sd=0.2 * MM)
SCENARIO = replace(RANDOMIZED, name="randomized, one puller", pullers=ONE)
"""Scenario ``randomized`` without its spread of pullers."""


class Row(NamedTuple):
    """Identification of a puller, and controllers designed for it."""

    truth: PullerFile
    identified: Identified
    passive: tuple[float, float]
    """Excitation of pull speed and heater in the log without excitation, in multiples of what is needed."""
    rmse_mm: tuple[float, ...]
    """Root mean square radius error of the LQGs told the truth, the identified file and the start [mm]."""
    lost: tuple[int, ...]
    """Number of crystals that each of these LQGs lost."""

    @property
    def inside(self) -> list[bool]:
        """True for each informed parameter whose interval holds the truth."""
        told = [e for e in self.identified.estimates if e.informed and e.name in Parameters._fields]
        return [e.low <= getattr(self.truth.parameters, e.name) <= e.high for e in told]


def errors_of_start(random: np.random.Generator) -> dict[str, float]:
    """Draw lognormal factors of the truth over a start file, by parameter."""
    sds = dict.fromkeys(HOT_ZONE, PRIOR_SD) | dict.fromkeys(MELT, MELT_SD)
    return {name: float(np.exp(sd * random.standard_normal())) for name, sd in sds.items()}


def draw(number: int) -> tuple[PullerFile, PullerFile]:
    """Draw the start file and the truth of a puller."""
    random, default = np.random.default_rng([5, number]), Parameters()
    r_0 = random.uniform(50.0, 150.0) * MM
    area = (r_0 / default.r_0) ** 2
    size = area * 2.0 ** random.uniform(-1.0, 1.0)
    scaled = dict.fromkeys(("C_1", "C_2", "C_b"), size) | dict.fromkeys(("kappa_12", "G_1a", "G_2b"), area)
    v_0 = default.v_0 * random.uniform(0.7, 1.3) * (default.r_0 / r_0) ** 0.5
    hot_zone = {name: factor * getattr(default, name) for name, factor in scaled.items()}
    start = default._replace(r_0=r_0, v_0=v_0, R_cr=3.2 * r_0, **hot_zone)
    truth = {name: getattr(start, name) * factor for name, factor in errors_of_start(random).items()}
    file = PullerFile(f"puller {number}", start, heater_range=area * HEATER_RANGE)
    return file, replace(file, parameters=start._replace(**truth))


def write_logs(truth: PullerFile, seed: int, folder: Path) -> tuple[Path, Path]:
    """Write CSV logs of three hours under a PID of the puller's own, with and without excitation."""
    env = CzEnv(SCENARIO, observation="measured", action="direct", puller=truth, info="all")
    (tuned,) = (each for each in PIDS if each.name == "pid-conventional")
    pid = tuned.settings(SCENARIO).for_config(env.config)
    assert isinstance(pid, FilteredPID)
    pid = replace(pid, heater=replace(pid.heater, K=pid.heater.K * truth.parameters.C_1 / Parameters().C_1))
    paths = folder / "excited.csv", folder / "passive.csv"
    for path, policy in zip(paths, (Excited(pid), pid), strict=True):
        record_log(env, policy, path, seed)
    return paths


def study(number: int, crystals: int) -> Row:
    """Draw a puller, log it, identify it, and run the LQGs on it."""
    start, truth = draw(number)
    with tempfile.TemporaryDirectory() as name:
        excited, passive = write_logs(truth, number, Path(name))
        outcome, without = identify(read_log(excited), start), measure_excitation([read_log(passive)], start)
        write_puller(outcome.puller, Path(name) / "my.toml")
        identified = read_puller(Path(name) / "my.toml")
    config = make_config(SCENARIO, observation="measured", action="direct", puller=truth)
    (tuned,) = (each for each in LQGS if each.name == FILTER)
    design = tuned.settings(config.sole_scenario)
    policies = [
        replace(LQG(design=design).for_config(config), parameters=told.parameters, puller=told, any_environment=True)
        for told in (truth, identified, start)
    ]
    runs = [rollout(policy, config, VALIDATION_SEEDS[:crystals]) for policy in policies]
    rmse = tuple(float(np.sqrt(np.mean(np.square(metrics(run).rmse_mm)))) for run in runs)
    return Row(truth, outcome, without, rmse, tuple(int(run.failed.sum()) for run in runs))


def report(rows: Sequence[Row]) -> str:
    """Write the table and what follows from it."""
    heads = "diameter [mm]", "heater [kW]", "told", "inside", "LQG told truth [mm]", "identified", "start", "lost"
    lines = []
    for row in rows:
        parameters, errors = row.truth.parameters, (f"{error:.3f}" for error in row.rmse_mm)
        machine = f"{2.0 * parameters.r_0 / MM:.0f}", f"{make_puller(parameters).Q_H_0 / KILO:.0f}"
        told = str(len(row.inside)), str(sum(row.inside))
        lines.append((*machine, *told, *errors, ", ".join(map(str, row.lost))))
    ratios = [row.rmse_mm[1] / row.rmse_mm[0] for row in rows]
    inside, lost = np.concatenate([row.inside for row in rows]), np.sum([row.lost for row in rows], axis=0)
    ratio = f"median {np.median(ratios):.3f}, worst {max(ratios):.3f}"
    return f"""{markdown(heads, lines)}

{len(rows)} pullers; error of the LQG of the identified file over that of the truth: {ratio}
crystals lost, told the truth, the identified file, the start: {", ".join(map(str, lost))}
intervals that hold the truth: {np.mean(inside) / PERCENT:.0f} % of {len(inside)} informed parameters
without excitation, logs that are said to tell the pull speed's path: {sum(row.passive[0] >= 1.0 for row in rows)}
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return StudyParser("identify", __doc__, "results/identify").run(_main, arguments)


def _main(given: argparse.Namespace) -> None:
    rows: list[Row] = []
    for number in range(PULLERS):
        rows.append(study(number, CRYSTALS))
        write_files({given.out / "pullers.txt": report(rows).encode()})
        print(f"puller {number}: RMSE {', '.join(f'{error:.3f}' for error in rows[-1].rmse_mm)} mm", flush=True)
    print(report(rows), end="")


if __name__ == "__main__":
    sys.exit(main())
