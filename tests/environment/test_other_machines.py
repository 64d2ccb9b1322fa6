"""The same numbers, or one line, where the process's environment is not ours. The kinds of other projects' bug reports:
numba #878 and #5566 (a compiler that is turned off), spinalcordtoolbox #4523 (a notebook's backend), and containers
without a home.
"""

import os
import sys

import numpy as np
import pytest

from cz_gym import CzEnv
from tests.processes import python

STEPS = """
import gymnasium as gym, numpy as np, cz_gym
one = gym.make("Cz-v0", scenario="puller", observation="measured")
two = cz_gym.CzVectorEnv(2, scenario="puller", observation="measured")
shown = one.reset(seed=1)[0], two.reset(seed=1)[0][0]
for _ in range(3):
    shown = one.step(np.zeros(2))[0], two.step(np.zeros((2, 2)))[0][0]
assert (shown[0] == shown[1]).all()
print(*shown[0])
"""
NOBODY = """
import pwd
def missing(user): raise KeyError(user)
pwd.getpwuid = missing
from cz_gym.jit import cache_folder
print(cache_folder())
"""
CURVES = """
from cz_gym.support.command_line import run_command
def body():
    from matplotlib.figure import Figure
    return print(7) or 0
run_command("command", body, "benchmark")
"""


def run(code, **changed):
    """What a process prints with these changes of the environment's variables; None removes one."""
    env = {name: value for name, value in {**os.environ, **changed}.items() if value is not None}
    return python("-W", "error", "-c", code, env=env)


def test_the_environment_gives_the_same_numbers_without_a_compiler():
    env = CzEnv(scenario="puller", observation="measured")
    seen = env.reset(seed=1)[0]
    for _ in range(3):
        seen = env.step(np.zeros(2))[0]
    printed = [float(word) for word in run(STEPS, NUMBA_DISABLE_JIT="1").split()]
    assert printed == pytest.approx(seen.tolist(), rel=1e-5, abs=1e-6)


@pytest.mark.skipif(sys.platform == "win32", reason="users as POSIX has them")
def test_a_user_without_a_home_has_no_cache():
    assert run(NOBODY, HOME=None, XDG_CACHE_HOME=None, CZ_GYM_CACHE_DIR=None) == "None\n"


def test_commands_draw_although_a_notebook_names_a_backend_that_is_missing():
    assert run(CURVES, MPLBACKEND="module://matplotlib_inline.backend_inline") == "7\n"
