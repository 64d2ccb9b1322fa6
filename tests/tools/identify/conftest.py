"""Logs of a puller whose hot zone differs from the default's, with and without excitation."""

from dataclasses import replace
from pathlib import Path

import pytest

from cz_gym import CzEnv, Parameters
from cz_gym.episodes.scenario import Pullers
from cz_gym.episodes.scenarios import RANDOMIZED
from cz_gym.tools.identify import Excited, Identified, identify, read_log, record_log
from cz_gym.tools.registry import find_controller

TRUTH = Parameters()._replace(C_1=8e4, C_2=7.5e4, kappa_12=3.4e-8, G_1a=24.0, G_2b=250.0, eps=0.25, sigma=0.75)
OWN = replace(RANDOMIZED, name="own", pullers=Pullers(start_radius_sd=2e-4))


@pytest.fixture(scope="session")
def logs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """CSV files of three hours, with and without excitation."""
    folder = tmp_path_factory.mktemp("logs")
    env = CzEnv(OWN, 0.5, "measured", parameters=TRUTH, action="direct", info="all")
    pid = find_controller("pid-conventional").make(env.config)
    for name, policy in (("excited.csv", Excited(pid)), ("passive.csv", pid)):
        assert record_log(env, policy, folder / name, seed=3) == 2161
    return folder / "excited.csv", folder / "passive.csv"


@pytest.fixture(scope="session")
def found(logs: tuple[Path, Path]) -> Identified:
    """What the log with excitation tells."""
    return identify(read_log(logs[0]))
