"""Logs of a puller whose hot zone differs from the file's, with and without excitation."""

from pathlib import Path

import pytest

from cz_gym.baselines.registry import find_controller
from cz_gym.identify import Excited, record_log
from tests.identify.puller import puller_env


@pytest.fixture(scope="session")
def logs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """CSV files of three hours, with and without excitation."""
    folder, env = tmp_path_factory.mktemp("logs"), puller_env()
    plain = find_controller("pid-conventional").make(env.config)
    excited, passive = folder / "excited.csv", folder / "passive.csv"
    assert record_log(env, Excited(plain), excited, seed=3) == 2161
    assert record_log(env, plain, passive, seed=3) == 2161
    return excited, passive
