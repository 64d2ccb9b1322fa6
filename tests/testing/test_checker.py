"""The checker fires on each way to break a vector environment, and says which in one line."""

import functools
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from cz_gym.testing.checker import Checked, NotConforming, check_vector_env, main
from cz_gym.testing.nested_arrays import KEEPERS, NamedArray, difference, flatten, keep

MODES = list(AutoresetMode)


class Walk(gym.Env[Any, Any]):
    """A random walk from a random start, that ends far away or after some steps."""

    observation_space: Any = Dict({"x": Box(-np.inf, np.inf, (2,), np.float32), "t": Box(0, 9, (1,), np.float32)})
    action_space: Any = Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.x, self.k = self.np_random.normal(size=2), 0
        return self._shown(), {"far": float(np.abs(self.x).max())}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.x, self.k = self.x + action[0] + self.np_random.normal(size=2), self.k + 1
        far = float(np.abs(self.x).max())
        return self._shown(), -far, far > 4.0, self.k >= 8, {"far": far, "hit": far > 2.0}

    def _shown(self) -> Any:
        return {"x": self.x.astype(np.float32), "t": np.array([self.k], np.float32)}


class Conforming(SyncVectorEnv):
    """Gymnasium's own vector of walks: what the toys below break."""

    def __init__(self, num_envs: int, mode: AutoresetMode) -> None:
        super().__init__([Walk] * num_envs, autoreset_mode=mode, copy=True)


class Space(Conforming):
    def __init__(self, num_envs: int, mode: AutoresetMode) -> None:
        super().__init__(num_envs, mode)
        self.single_action_space = Box(-2, 2, (1,), np.float32)


class Batched(Conforming):
    def __init__(self, num_envs: int, mode: AutoresetMode) -> None:
        super().__init__(num_envs, mode)
        self.action_space = self.single_action_space


class Mode(Conforming):
    def __init__(self, num_envs: int, mode: AutoresetMode) -> None:
        super().__init__(num_envs, AutoresetMode.NEXT_STEP)


class Fewer(Conforming):
    def __init__(self, num_envs: int, mode: AutoresetMode) -> None:
        super().__init__(num_envs - 1, mode)


class Seedless(Conforming):
    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return super().reset(seed=None, options=options)


class Stuck(Conforming):
    """The same first state whatever the seed: each slot another."""

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        masked = options is not None and "reset_mask" in options
        return super().reset(seed=None if masked else 5, options=options)


class Alike(Conforming):
    """Every slot gets the first seed."""

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return super().reset(seed=[seed] * self.num_envs if isinstance(seed, int) else seed, options=options)


class SeedList(Conforming):
    """The list is read as its first seed, plus the slot."""

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return super().reset(seed=seed[0] if isinstance(seed, list) else seed, options=options)


class Repeating(Conforming):
    """Autoreset replays each slot's first state, as in brax."""

    def __init__(self, num_envs: int, mode: AutoresetMode) -> None:
        super().__init__(num_envs, mode)
        for env in self.envs:
            env.reset = functools.partial(self._again, env)  # type: ignore[method-assign]

    @staticmethod
    def _again(env: Any, seed: int | None = None, options: Any = None) -> Any:
        shown = Walk.reset(env, seed=seed, options=options)
        if seed is not None or not hasattr(env, "first"):
            env.first = env.x.copy()
            return shown
        env.x = env.first.copy()
        return env._shown(), {"far": float(np.abs(env.x).max())}


class Rewards32(Conforming):
    def step(self, actions: Any) -> Any:
        observation, reward, *rest = super().step(actions)
        return observation, reward.astype(np.float32), *rest


class Observations64(Conforming):
    def step(self, actions: Any) -> Any:
        observation, *rest = super().step(actions)
        return {name: part.astype(np.float64) for name, part in observation.items()}, *rest


class Unmasked(Conforming):
    def step(self, actions: Any) -> Any:
        *rest, infos = super().step(actions)
        return *rest, {key: value for key, value in infos.items() if key != "_far"}


class Reward(Conforming):
    def step(self, actions: Any) -> Any:
        observation, reward, *rest = super().step(actions)
        reward[1] *= 1.0 + 1e-12
        return observation, reward, *rest


class Timeout(Conforming):
    """The time limit is returned as a failure, as in pc-gym."""

    def step(self, actions: Any) -> Any:
        observation, reward, terminated, truncated, infos = super().step(actions)
        return observation, reward, terminated | truncated, np.zeros_like(truncated), infos


class Info(Conforming):
    def step(self, actions: Any) -> Any:
        *rest, infos = super().step(actions)
        infos["far"] = infos["far"] + 1e-9
        return *rest, infos


class Extra(Conforming):
    def step(self, actions: Any) -> Any:
        *rest, infos = super().step(actions)
        extra = {"secret": np.zeros(self.num_envs), "_secret": np.ones(self.num_envs, np.bool_)}
        return *rest, infos | extra


class Final(Conforming):
    """The final observation is the next episode's first."""

    def step(self, actions: Any) -> Any:
        observation, *rest, infos = super().step(actions)
        for i in np.flatnonzero(infos.get("_final_obs", [])):
            infos["final_obs"][i] = {name: part[i].copy() for name, part in observation.items()}
        return observation, *rest, infos


class Coupled(Conforming):
    """Slot 0's action moves every slot."""

    def step(self, actions: Any) -> Any:
        return super().step(np.repeat(actions[:1], self.num_envs, axis=0))


class Reused(Conforming):
    """Observations are returned without a copy."""

    def __init__(self, num_envs: int, mode: AutoresetMode) -> None:
        SyncVectorEnv.__init__(self, [Walk] * num_envs, autoreset_mode=mode, copy=False)


class Recycled(Conforming):
    """Rewards alternate between two arrays."""

    def step(self, actions: Any) -> Any:
        if not hasattr(self, "arrays"):
            self.arrays = [np.zeros(self.num_envs), np.zeros(self.num_envs)]
        observation, reward, *rest = super().step(actions)
        self.arrays.reverse()
        self.arrays[0][:] = reward
        return observation, self.arrays[0], *rest


class ReadBack(Conforming):
    """Rewards carry over what is in the array that was handed out."""

    last: Any = None

    def step(self, actions: Any) -> Any:
        observation, reward, *rest = super().step(actions)
        if self.last is not None:
            reward = reward + (self.last[0] - self.last[1])
        self.last = reward, reward.copy()
        return observation, reward, *rest


class KeepsActions(Conforming):
    """An action is still read one step later."""

    last: Any = None

    def step(self, actions: Any) -> Any:
        observation, reward, *rest = super().step(actions)
        if self.last is not None:
            reward = reward + (self.last[0] - self.last[1])[:, 0]
        self.last = actions, actions.copy()
        return observation, reward, *rest


class WritesActions(Conforming):
    def step(self, actions: Any) -> Any:
        result = super().step(actions)
        actions *= 0.5
        return result


class ResetsAll(Conforming):
    """The reset mask is ignored."""

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return super().reset(seed=seed)


BROKEN: dict[type[Conforming], str] = {
    Space: "single_action_space is",
    Batched: "action_space is .* the batch of 3 is",
    Mode: r"metadata\['autoreset_mode'\] is",
    Fewer: "num_envs is 2, asked for 3",
    Seedless: "seed 0 gives another first observation in a second environment",
    Stuck: "differs from the scalar with that seed",
    Alike: "slots 0 and 1 have the same first observation",
    SeedList: "seed list: slot 1 with seed 14 differs",
    Repeating: "the same first observations",
    Rewards32: "reward is float32 .3,. and float64 .3,.",
    Observations64: r"observation\['t'\] is float64 .* and float32",
    Unmasked: r"info\['_far'\] is in one only",
    Reward: r"reward of slot 1 is .* and",
    Timeout: "terminated of slot . is True and False",
    Info: r"info\['far'\] of slot 0 is",
    Extra: r"info\['_secret'\], info\['secret'\] is in one only",
    Final: r"info\['final_obs'\]\[.\]\['t'\]",
    Coupled: r"observation\['x'\] of slot 1",
    Reused: "was written by a later call",
    Recycled: r"\[1\] .kept as .* was written by a later call",
    ReadBack: "writing into earlier results or actions changed",
    KeepsActions: "writing into earlier results or actions changed",
    WritesActions: "wrote into the actions",
    ResetsAll: "reset of ended slots",
}
"""Each with what is said of it."""
SHOWN_IN = {Mode: AutoresetMode.SAME_STEP, Final: AutoresetMode.SAME_STEP, ResetsAll: AutoresetMode.DISABLED}
"""The mode that shows it; of the others, NEXT_STEP."""


@pytest.mark.parametrize("mode", MODES)
def test_gymnasiums_own_vector_conforms(mode: AutoresetMode) -> None:
    checked = check_vector_env(Conforming, Walk, steps=40, modes=[mode])
    assert checked.steps == 4 * 40
    assert checked.episodes > checked.failures > 10
    assert checked.held > 40 * 4


@pytest.mark.parametrize("broken", BROKEN, ids=lambda broken: broken.__name__)
def test_each_break_is_named_in_one_line(broken: Any) -> None:
    mode = SHOWN_IN.get(broken, AutoresetMode.NEXT_STEP)
    with pytest.raises(NotConforming, match=BROKEN[broken]) as found:
        check_vector_env(broken, Walk, steps=40, modes=[mode])
    assert "\n" not in str(found.value)
    assert str(found.value).startswith(f"[{mode.value}] ")


def test_a_replayed_start_is_found_where_no_seed_shows_it() -> None:
    class Replays(Repeating):
        """A reset of the user's draws; only autoreset replays."""

        def reset(self, *, seed: Any = None, options: Any = None) -> Any:
            for env in self.envs:
                if options is None:
                    env.__dict__.pop("first", None)
            return super().reset(seed=seed, options=options)

    with pytest.raises(NotConforming, match=r"step \d+: slot . begins again with a first observation it had before"):
        check_vector_env(Replays, Walk, steps=40, modes=[AutoresetMode.NEXT_STEP])


def test_a_check_that_sees_no_end_is_no_check() -> None:
    class Endless(Walk):
        def step(self, action: Any) -> Any:
            observation, reward, _, _, info = super().step(action)
            return observation | {"t": np.zeros(1, np.float32)}, reward, False, False, info

    with pytest.raises(NotConforming, match="no episode ended in 5 steps"):
        check_vector_env(lambda n, mode: SyncVectorEnv([Endless] * n, autoreset_mode=mode), Endless, steps=5)


def test_a_tolerance_forgives_rounding_alone() -> None:
    checked = check_vector_env(Reward, Walk, steps=40, modes=[AutoresetMode.NEXT_STEP], rtol=1e-9)
    assert isinstance(checked, Checked)
    with pytest.raises(NotConforming):
        check_vector_env(Timeout, Walk, steps=40, modes=[AutoresetMode.NEXT_STEP], rtol=1e-9)


@pytest.mark.parametrize("arguments", [{"num_envs": 1}, {"steps": 1}, {"modes": []}])
def test_bad_arguments_are_refused(arguments: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="a check needs num_envs"):
        check_vector_env(Conforming, Walk, **arguments)


@pytest.mark.parametrize("number", range(len(KEEPERS)))
@pytest.mark.parametrize("dtype", [np.float32, np.bool_])
def test_every_way_to_keep_an_array_sees_a_later_write(number: int, dtype: type) -> None:
    array = np.zeros((3, 2), dtype)
    kept = keep(NamedArray("x", array), number)
    assert kept.keeper == list(KEEPERS)[number]
    assert kept.unchanged
    array[2, 1] = 1
    assert not kept.unchanged


def test_differences_in_words() -> None:
    one = {"a": np.array([1.0, np.nan]), "_a": np.array([True, False])}
    assert difference(flatten(one), flatten(one)) is None
    other = {"a": np.array([1.0, 7.0]), "_a": np.array([True, False])}
    assert difference(flatten(one), flatten(other)) == "a of slot 1 is nan and 7.0"
    assert difference(flatten(one), flatten(other), masked=True) is None
    assert difference(flatten(np.zeros(2)), flatten(np.zeros(3))) == " is float64 (2,) and float64 (3,)"


@pytest.mark.parametrize("argv", [["--steps", "3"], ["--slots", "1"], ["--stepps", "60"]])
def test_the_command_refuses_in_one_line(argv: list[str], refused: Any) -> None:
    refused(main, argv)
