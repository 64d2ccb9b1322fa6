"""A machine of another structure, through the documented commands: ``python -m tests.other_machine``.

Log under the machine's own PID, ``cz-gym identify``, ``cz-gym tune``, ``cz-gym export``, and the compiled block in the
loop while the heater's reading is k times the power. The report stands in results/other_machine.
"""

import argparse
from pathlib import Path

import numpy as np

from cz_gym import Parameters
from cz_gym.config import make_config
from cz_gym.puller.file import PullerFile, read_puller, write_puller
from cz_gym.support.files import write_files
from cz_gym.tools import tune
from cz_gym.tools.export import command as export
from cz_gym.tools.export.block import OUTPUTS
from cz_gym.tools.export.controllers import FALLBACK, make_block
from cz_gym.tools.export.text import CompiledBlock
from cz_gym.tools.identify import command as identify
from cz_gym.tools.report.tables import markdown
from studies.identify import errors_of_start
from tests.foreign_puller import ODD, SLOW, ZONE, ForeignPuller, Operator, drive, write_log

MACHINE = ZONE | {name: ZONE[name] * factor for name, factor in errors_of_start(np.random.default_rng([11, 1])).items()}
"""The machine's hot zone, which the start file has wrong."""
SCALES = 1.0, 0.995, 0.99, 1.01, 0.97, 1.03
"""Factors on the reading of the heater's power."""
SETTLED = 1800.0
"""Time from which errors count [s]."""


def file_of(zone, **delays):
    """A puller file of a machine's numbers, with its drives and sensors."""
    numbers = {name: value for name, value in zone.items() if name != "lam"}
    return PullerFile(
        "machine", Parameters()._replace(**numbers), control_interval=2.0, latency=0.0,
        pull_window=SLOW["pull_window"] / 6e4, pull_slew=SLOW["pull_slew"] / 6e4, heater_slew=SLOW["heater_slew"],
        heater_step=SLOW["heater_step"], camera_noise=(5e-5, 5e-5), pyrometer_noise=(0.1, 0.1), **delays,
    )  # fmt: skip


def block_for(name, file):
    """A controller's block for a puller file, compiled."""
    return CompiledBlock(
        make_block(name, make_config("randomized", observation="measured", action="direct", puller=file))
    )


def hold(block, puller, hours=3.0, scale=1.0):
    """Root mean square radius error [mm] of a machine after half an hour under a block; infinite if it is lost.

    As an operator does, nominal power, temperature and ring are trimmed to the machine's.
    """
    memory, power = block.start(1), puller.power_0 / 1e3
    trims = {
        "ring_bias_mm": 1e3 * puller.ring_bias, "nominal_T_1_K": puller.T_1_0, "nominal_heater_power_kW": power,
        "oldest_reading_s": 20.0, "heater_power_min_kW": power - 10.0, "heater_power_max_kW": power + 10.0,
    }  # fmt: skip

    def setpoints(seen):
        nonlocal memory
        read = {"heater_power_kW": scale * seen["heater_power_kW"], "automatic": 1.0}
        outputs, memory = block.run({**seen, **trims, **read}, memory)
        return {port.name: float(outputs[port.name][0]) for port in OUTPUTS}

    return error_of(drive(puller, setpoints, hours), puller)


def error_of(rows, puller):
    """Root mean square radius error of a machine's rows [mm]; infinite if the crystal was lost."""
    errors = [row["true_radius_mm"] - row["r_ref_mm"] for row in rows if row["time_s"] >= SETTLED]
    return np.inf if puller.lost else float(np.sqrt(np.mean(np.square(errors))))


def machine(seed):
    """A crystal on the machine."""
    return ForeignPuller(MACHINE, seed, **SLOW | ODD)


def cell(errors):
    """Errors of kept crystals [mm], and how many were lost."""
    kept = [f"{error:.2f}" for error in errors if np.isfinite(error)]
    return f"{', '.join(kept) or '-'}; {len(errors) - len(kept)} lost"


def main(arguments=None):
    """The chain, and its report."""
    parser = argparse.ArgumentParser("python -m tests.other_machine", description="The commands on another machine.")
    parser.add_argument("--out", type=Path, default=Path("results/other_machine"))
    parser.add_argument(
        "--work", type=Path, default=Path("runs/other_machine"), help="folder of logs, files and blocks"
    )
    parser.add_argument("--crystals", type=int, default=3)
    parser.add_argument("--hours", type=float, default=1.5)
    parser.add_argument("--trials", type=int, default=12)
    given = parser.parse_args(arguments)
    work, names = given.work, ("lqg-at-0.02", "paper-tuned")
    work.mkdir(parents=True, exist_ok=True)
    first = machine(1)
    rows = drive(first, Operator(first, 1).setpoints)
    historian = {"second": 1.0, "jitter": 0.3, "missing_rows": 0.02, "missing_drives": 0.05, "digits": (2, 3, 2, 1)}
    write_log(work / "log.csv", rows, 1, **historian)
    write_puller(file_of(ZONE), work / "start.toml")
    command = [str(work / "log.csv"), "--puller", str(work / "start.toml"), "--out", str(work / "my.toml")]
    fits = identify.main([*command, "--force"]) == 0
    print((work / "my.md").read_text().splitlines()[0], flush=True)
    for name in names:
        trials = ["--trials", str(given.trials), "--episodes", "5"]
        tune.main(["--puller", str(work / "my.toml"), "--controller", name, *trials])
        export.main([name, "--puller", str(work / "my.toml"), "--to", "c", "--out", str(work / name)])
    seeds = range(100, 100 + given.crystals)
    alone = []
    for puller in map(machine, seeds):
        alone.append(error_of(drive(puller, Operator(puller, 0, (0.0, 0.0)).setpoints, given.hours), puller))
    table = [("its own PID", cell(alone), *[""] * (len(SCALES) - 1))]
    for name in (*names, FALLBACK):
        block = block_for(name, read_puller(work / "my.toml"))
        cells = [cell([hold(block, machine(seed), given.hours, scale) for seed in seeds]) for scale in SCALES]
        table.append((name, *cells))
        print(*table[-1], flush=True)
    odd = ", ".join(f"{name.replace('_', ' ')} {value:.3g}" for name, value in ODD.items())
    verdict = "the model fits" if fits else "the model does not fit, and the file was forced"
    text = f"""# A machine of another structure, through the documented commands

Beyond any puller file: {odd}.
Identification: {verdict}. Searches of {given.trials} candidates on 5 crystals. Radius error of
each of {given.crystals} crystals of {given.hours:g} h from half an hour on [mm], the reading of the heater's power
being k times the power:

{markdown(("controller", *(f"k = {scale:g}" for scale in SCALES)), table)}
"""
    write_files({given.out / "report.md": text.encode()})
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
