"""The controller over OPC UA: the same crystal as in Python, step for step."""

import os
import shutil

import numpy as np
import pytest

from cz_gym.baselines.clairvoyant import episodes_of
from cz_gym.config import make_config
from cz_gym.evaluation.rollout import rollout
from cz_gym.support.units import KILO, MM, MM_PER_MIN
from cz_gym.tools.export.controllers import make_block
from cz_gym.tools.export.shell import BlockPolicy
from examples import opcua_controller
from tests.tools.serve.conftest import PASSWORD, running

needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="cc is not installed: no C can be compiled")


@pytest.mark.parametrize(
    ("name", "scenario", "options", "steps"),
    [
        ("paper", "randomized", (), 200),
        ("ppo", "puller", (), 100),
        pytest.param("gradient", "puller", ("--compiled",), 200, marks=(needs_compiler, pytest.mark.slow)),
        pytest.param("paper", "randomized", (), 2160, marks=pytest.mark.slow),
    ],
)
def test_the_loop_over_opc_ua_is_the_loop_in_python(name, scenario, options, steps, tmp_path):
    """To the float32 of observations and of the twin's actions."""
    with running(tmp_path, "--speed", "0", "--scenario", scenario) as puller:
        chosen = ["--controller", name, "--scenario", scenario, "--steps", str(steps), *options]
        assert opcua_controller.main(["--url", puller.url, *chosen]) == 0
        rows = np.genfromtxt(tmp_path / "log.csv", delimiter=",", names=True)[1:]
    shown = "ring_radius_mm", "pull_speed_mm_per_min", "heater_power_kW"
    found = np.stack([rows[name] for name in shown], axis=-1)
    config = make_config(scenario, observation="measured", action="direct", horizon=steps * 5.0)
    s = rollout(BlockPolicy(make_block(name, config)), config, [1]).signals
    (e,) = episodes_of(config, [1])  # its drives are read with these errors
    read = e.pull_scale * s.v_p / MM_PER_MIN, e.heater_scale * s.Q_H / KILO
    twin = np.concatenate([s.r_br_measured / MM, *read], axis=-1)
    assert len(found) >= steps - 1
    np.testing.assert_allclose(found, twin[: len(found)], rtol=0, atol=5e-6)


def test_it_logs_in_over_an_encrypted_channel(tmp_path, monkeypatch):
    monkeypatch.setenv("CZ_GYM_OPERATOR_PASSWORD", PASSWORD)
    with running(tmp_path, "--operator", "olga", "--speed", "0", remote=True) as puller:
        login = ["--operator", "olga", "--encrypt", str(tmp_path / "certificates" / "certificate.pem")]
        own = ["--certificates", str(tmp_path / "client"), "--steps", "3"]
        assert opcua_controller.main(["--url", puller.url, *login, *own]) == 0
        assert puller.machine.answered == 2
    assert sorted(os.listdir(tmp_path / "client")) == ["certificate.pem", "key.pem"]


def test_a_server_that_is_not_there_and_a_controller_that_is_not_are_said_in_one_line(refused):
    assert "127.0.0.1" in refused(opcua_controller.main, ["--url", "opc.tcp://127.0.0.1:9/"])
    assert "did you mean 'paper'" in refused(opcua_controller.main, ["--controller", "papr"])
