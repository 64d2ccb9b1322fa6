"""The checker of vector environments fires on each way to break one, and says which in one line."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from tests.vector_checker import NotConforming, check_vector_env

NEXT, SAME, DISABLED = AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP, AutoresetMode.DISABLED


class Walk(gym.Env[Any, Any]):
    """A random walk from a random start, that ends far away or after some steps."""

    observation_space: Any = Dict({"x": Box(-np.inf, np.inf, (2,), np.float32), "t": Box(0, 9, (1,), np.float32)})
    action_space: Any = Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.k = self.np_random.normal(size=2), 0
        return self._shown(), {"far": float(np.abs(self.x).max())}

    def step(self, action):
        self.x, self.k = self.x + action[0] + self.np_random.normal(size=2), self.k + 1
        far = float(np.abs(self.x).max())
        return self._shown(), -far, far > 4.0, self.k >= 8, {"far": far, "hit": far > 2.0}

    def _shown(self):
        return {"x": self.x.astype(np.float32), "t": np.array([self.k], np.float32)}


def vector(
    num_envs=3,
    mode=NEXT,
    made=None,
    reset=lambda seed, options: {},
    step=lambda *result: result,
    after=lambda given: None,
):
    """Gymnasium's vector of walks, changed once it is made, that resets with other arguments, returns something else
    from a step, or does something to the actions after it."""

    class Broken(SyncVectorEnv):
        def reset(self, *, seed=None, options=None):
            return super().reset(**{"seed": seed, "options": options, **reset(seed, options)})

        def step(self, actions):
            result = step(*super().step(actions))
            after(actions)
            return result

    env = Broken([Walk] * num_envs, autoreset_mode=mode, copy=True)
    vars(env).update(made or {})
    return env


def reads_back():
    """A step whose rewards carry over what is in the array that was handed out."""
    handed = [np.zeros(3)] * 2

    def step(observation, reward, *rest):
        reward = reward + (handed[0] - handed[1])
        handed[:] = reward, reward.copy()
        return observation, reward, *rest

    return step


def next_first(observation, *rest):
    """The final observation is the next episode's first."""
    infos = rest[-1]
    for i in np.flatnonzero(infos.get("_final_obs", [])):
        infos["final_obs"][i] = {name: part[i].copy() for name, part in observation.items()}
    return observation, *rest


BROKEN: dict[str, tuple[dict[str, Any], AutoresetMode]] = {
    "single_action_space is": ({"made": {"single_action_space": Box(-2, 2, (1,))}}, NEXT),
    "seed 0 gives another first observation in a second environment": ({"reset": lambda *_: {"seed": None}}, NEXT),
    "slots 0 and 1 have the same first observation": (
        {"reset": lambda seed, _: {"seed": [seed] * 3 if isinstance(seed, int) else seed}}, NEXT),
    "seed list: slot 1 with seed 14 differs": (
        {"reset": lambda seed, _: {"seed": seed[0] if isinstance(seed, list) else seed}}, NEXT),
    r"observation\['t'\] is float64 .* and float32": (
        {"step": lambda shown, *rest: ({k: v.astype(float) for k, v in shown.items()}, *rest)}, NEXT),
    r"info\['_far'\] is in one only": (
        {"step": lambda *result: (*result[:4], {k: v for k, v in result[4].items() if k != "_far"})}, NEXT),
    "reward of slot 1 is .* and": ({"step": lambda o, r, *rest: (o, r * [1.0, 1.0 + 1e-12, 1.0], *rest)}, NEXT),
    "terminated of slot . is True and False": (
        {"step": lambda o, r, failed, late, info: (o, r, failed | late, np.zeros_like(late), info)}, NEXT),
    r"info\['final_obs'\]\[.\]\['t'\]": ({"step": next_first}, SAME),
    "was written by a later call": ({"made": {"copy": False}}, NEXT),
    "writing into earlier results or actions changed": ({"step": reads_back}, NEXT),
    "wrote into the": ({"after": lambda actions: actions.fill(0.5)}, NEXT),
    "reset of ended slots": ({"reset": lambda *_: {"options": None}}, DISABLED),
}  # fmt: skip
"""Changes of the vector by what is said of them, and the mode that shows them."""


@pytest.mark.parametrize("mode", AutoresetMode)
def test_gymnasiums_own_vector_conforms(mode):
    checked = check_vector_env(vector, Walk, steps=40, mode=mode)
    assert checked.episodes > checked.failures > 2
    assert checked.held > 40 * 4


@pytest.mark.parametrize("says", BROKEN)
def test_each_break_is_named_in_one_line(says):
    changes, mode = BROKEN[says]

    def broken(n, mode):
        own = {name: change() if change is reads_back else change for name, change in changes.items()}
        return vector(n, mode, **own)

    with pytest.raises(NotConforming, match=says) as caught:
        check_vector_env(broken, Walk, steps=40, mode=mode)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(f"[{mode.value}] ")
