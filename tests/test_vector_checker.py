"""The checker fires on each way to break a vector environment, and says which in one line."""

import functools
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from tests.vector_checker import NotConforming, check_vector_env


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


class Conforming(SyncVectorEnv):
    """Gymnasium's own vector of walks: what the toys below break."""

    def __init__(self, num_envs, mode):
        super().__init__([Walk] * num_envs, autoreset_mode=mode, copy=True)


def odd(
    made=lambda env: None,
    reset=lambda seed, options: {},
    acts=lambda actions: actions,
    step=lambda *result: result,
    after=lambda actions: None,
    fewer=0,
    always=None,
):
    """A vector that is changed once it is made, resets with other arguments, takes other actions, returns something
    else from a step, or does something to the actions after it; of fewer slots, or always of one mode."""

    class Broken(Conforming):
        def __init__(self, num_envs, mode):
            super().__init__(num_envs - fewer, always or mode)
            made(self)

        def reset(self, *, seed=None, options=None):
            return super().reset(**{"seed": seed, "options": options, **reset(seed, options)})

        def step(self, actions):
            result = step(*super().step(acts(actions)))
            after(actions)
            return result

    return Broken


class Repeating(Conforming):
    """Autoreset replays each slot's first state, as in brax."""

    def __init__(self, num_envs, mode):
        super().__init__(num_envs, mode)
        for env in self.envs:
            env.reset = functools.partial(self._again, env)

    @staticmethod
    def _again(env, seed=None, options=None):
        shown = Walk.reset(env, seed=seed, options=options)
        if seed is not None or not hasattr(env, "first"):
            env.first = env.x.copy()
            return shown
        env.x = env.first.copy()
        return env._shown(), {"far": float(np.abs(env.x).max())}


def next_first(observation, *rest):
    """The final observation is the next episode's first."""
    infos = rest[-1]
    for i in np.flatnonzero(infos.get("_final_obs", [])):
        infos["final_obs"][i] = {name: part[i].copy() for name, part in observation.items()}
    return observation, *rest


class Recycled(Conforming):
    """Rewards alternate between two arrays."""

    def step(self, actions):
        if not hasattr(self, "arrays"):
            self.arrays = [np.zeros(self.num_envs), np.zeros(self.num_envs)]
        observation, reward, *rest = super().step(actions)
        self.arrays.reverse()
        self.arrays[0][:] = reward
        return observation, self.arrays[0], *rest


class ReadBack(Conforming):
    """Rewards carry over what is in the array that was handed out, or handed in."""

    last: Any = None

    def step(self, actions):
        observation, reward, *rest = super().step(actions)
        if self.last is not None:
            reward = reward + (self.last[0] - self.last[1])
        self.last = self.remembered(reward, actions)
        return observation, reward, *rest

    def remembered(self, reward, actions):
        return reward, reward.copy()


class KeepsActions(ReadBack):
    def remembered(self, reward, actions):
        return actions[:, 0], actions[:, 0].copy()


REWARD = odd(step=lambda observation, reward, *rest: (observation, reward * [1.0, 1.0 + 1e-12, 1.0], *rest))
TIMEOUT = odd(step=lambda o, r, failed, truncated, i: (o, r, failed | truncated, np.zeros_like(truncated), i))
"""The time limit is returned as a failure, as in pc-gym."""
NEXT, SAME, DISABLED = AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP, AutoresetMode.DISABLED
BROKEN = {
    "space": (odd(lambda env: setattr(env, "single_action_space", Box(-2, 2, (1,)))), "single_action_space is", NEXT),
    "batched": (odd(lambda env: setattr(env, "action_space", env.single_action_space)),
                "action_space is .* the batch of 3 is", NEXT),
    "mode": (odd(always=NEXT), r"metadata\['autoreset_mode'\] is", SAME),
    "fewer": (odd(fewer=1), "num_envs is 2, asked for 3", NEXT),
    "seedless": (odd(reset=lambda seed, options: {"seed": None}),
                 "seed 0 gives another first observation in a second environment", NEXT),
    "stuck": (odd(reset=lambda seed, options: {"seed": None if "reset_mask" in (options or {}) else 5}),
              "differs from the scalar with that seed", NEXT),
    "alike": (odd(reset=lambda seed, options: {"seed": [seed] * 3 if isinstance(seed, int) else seed}),
              "slots 0 and 1 have the same first observation", NEXT),
    "first of a seed list": (odd(reset=lambda seed, options: {"seed": seed[0] if isinstance(seed, list) else seed}),
                            "seed list: slot 1 with seed 14 differs", NEXT),
    "repeating": (Repeating, "the same first observations", NEXT),
    "observations of 64 bits": (odd(step=lambda shown, *rest: ({k: v.astype(float) for k, v in shown.items()}, *rest)),
                                r"observation\['t'\] is float64 .* and float32", NEXT),
    "unmasked": (odd(step=lambda *result: (*result[:4], {k: each for k, each in result[4].items() if k != "_far"})),
                 r"info\['_far'\] is in one only", NEXT),
    "reward": (REWARD, "reward of slot 1 is .* and", NEXT),
    "time limit": (TIMEOUT, "terminated of slot . is True and False", NEXT),
    "final": (odd(step=next_first), r"info\['final_obs'\]\[.\]\['t'\]", SAME),
    "coupled": (odd(acts=lambda actions: np.repeat(actions[:1], len(actions), axis=0)),
                r"observation\['x'\] of slot 1", NEXT),
    "reused": (odd(lambda env: setattr(env, "copy", False)), "was written by a later call", NEXT),
    "recycled": (Recycled, r"\[1\] .kept as .* was written by a later call", NEXT),
    "reads results back": (ReadBack, "writing into earlier results or actions changed", NEXT),
    "keeps actions": (KeepsActions, "writing into earlier results or actions changed", NEXT),
    "writes actions": (odd(after=lambda actions: actions.fill(0.5)), "wrote into the", NEXT),
    "resets all": (odd(reset=lambda seed, options: {"options": None}), "reset of ended slots", DISABLED),
}  # fmt: skip
"""Each with what is said of it, and the mode that shows it."""


@pytest.mark.parametrize("mode", AutoresetMode)
def test_gymnasiums_own_vector_conforms(mode):
    checked = check_vector_env(Conforming, Walk, steps=40, mode=mode)
    assert checked.episodes > checked.failures > 2
    assert checked.held > 40 * 4


@pytest.mark.parametrize("name", BROKEN)
def test_each_break_is_named_in_one_line(name):
    make, says, mode = BROKEN[name]
    with pytest.raises(NotConforming, match=says) as found:
        check_vector_env(make, Walk, steps=40, mode=mode)
    assert "\n" not in str(found.value)
    assert str(found.value).startswith(f"[{mode.value}] ")


def test_a_replayed_start_is_found_where_no_seed_shows_it():
    class Replays(Repeating):
        """A reset of the user's draws; only autoreset replays."""

        def reset(self, *, seed=None, options=None):
            for env in self.envs:
                if options is None:
                    env.__dict__.pop("first", None)
            return super().reset(seed=seed, options=options)

    with pytest.raises(NotConforming, match=r"step \d+: slot . begins again with a first observation it had before"):
        check_vector_env(Replays, Walk, steps=40, mode=NEXT)


def test_a_check_that_sees_no_end_is_no_check():
    class Endless(Walk):
        def step(self, action):
            observation, reward, _, _, info = super().step(action)
            return observation | {"t": np.zeros(1, np.float32)}, reward, False, False, info

    with pytest.raises(NotConforming, match="no episode ended in 5 steps"):
        check_vector_env(lambda n, mode: SyncVectorEnv([Endless] * n, autoreset_mode=mode), Endless, mode=NEXT, steps=5)
