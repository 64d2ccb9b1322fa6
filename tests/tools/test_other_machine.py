"""A machine that is not ours, from its log to the compiled controller that drives it."""

import shutil

import numpy as np
import pytest

from cz_gym import Parameters
from cz_gym.config import make_config
from cz_gym.puller.file import PullerFile
from cz_gym.tools.export.block import OUTPUTS
from cz_gym.tools.export.controllers import make_block
from cz_gym.tools.export.text import CompiledBlock
from cz_gym.tools.identify import identify, read_log
from studies.identify import wrong
from tests.foreign_puller import SLOW, ZONE, ForeignPuller, Operator, drive, write_log

LAG = 10.0
"""The heater's lag, which the start file does not know [s]."""
TRUTH = ZONE | {name: ZONE[name] * factor for name, factor in wrong(np.random.default_rng([11, 1])).items()}
"""The machine's hot zone, which the start file has wrong."""


def file_of(zone, **delays):
    """A puller file of a machine's numbers, with its drives and sensors."""
    numbers = {name: value for name, value in zone.items() if name != "lam"}
    return PullerFile(
        "machine", Parameters()._replace(**numbers), control_interval=2.0, latency=0.0,
        pull_window=SLOW["pull_window"] / 6e4, pull_slew=SLOW["pull_slew"] / 6e4, heater_slew=SLOW["heater_slew"],
        heater_step=SLOW["heater_step"], camera_noise=(5e-5, 5e-5), pyrometer_noise=(0.1, 0.1), **delays,
    )  # fmt: skip


def hold(file):
    """Root mean square radius error [mm] of the machine after half an hour, under the block exported for a file.

    As an operator does, nominal power, temperature and ring are trimmed to the machine's.
    """
    config = make_config("randomized", observation="measured", action="direct", puller=file)
    block, puller = CompiledBlock(make_block("lqg", config)), ForeignPuller(TRUTH, 100, **SLOW, heater_lag=LAG)
    memory, power = block.start(1), puller.power_0 / 1e3
    trims = {
        "ring_bias_mm": 1e3 * puller.ring_bias, "nominal_T_1_K": puller.T_1_0, "nominal_heater_power_kW": power,
        "oldest_reading_s": 20.0, "heater_power_min_kW": power - 10.0, "heater_power_max_kW": power + 10.0,
    }  # fmt: skip

    def setpoints(seen):
        nonlocal memory
        outputs, memory = block.run({**seen, **trims, "automatic": 1.0}, memory)
        return {port.name: float(outputs[port.name][0]) for port in OUTPUTS}

    rows = drive(puller, setpoints)
    assert not puller.lost
    return np.sqrt(np.mean([(row["true_radius_mm"] - row["r_ref_mm"]) ** 2 for row in rows if row["time_s"] >= 1800.0]))


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_a_machine_by_somebody_else_is_logged_identified_designed_for_and_driven(tmp_path):
    puller = ForeignPuller(TRUTH, 1, **SLOW, heater_lag=LAG)
    historian = {"second": 1.0, "jitter": 0.3, "missing_rows": 0.02, "missing_drives": 0.05, "digits": (2, 3, 2, 1)}
    log = write_log(tmp_path / "log.csv", drive(puller, Operator(puller, 1).setpoints), 1, **historian)
    identified = identify(read_log(log), file_of(ZONE))
    assert not identified.misfits
    assert hold(identified.puller) < 2.0 * hold(file_of(TRUTH, heater_lag=(LAG, LAG)))
