"""The batch is a vector of scalars, under checkers of others and ours, which names each break in one line."""

import multiprocessing
import pickle
import sys
import threading
import warnings
from time import perf_counter
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box, Dict
from gymnasium.utils.env_checker import check_env as check_with_gymnasium
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import TransformObservation
from stable_baselines3.common.env_checker import check_env as check_with_sb3

from cz_gym import SCENARIOS, CzEnv, CzVectorEnv
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.spaces import OBSERVATIONS
from cz_gym.vector_checker import NotConforming, check_vector_env

SHORT = {"control_interval": 60.0, "horizon": 1200.0}


def conforming(settings, **options):
    """What a check of these settings counts; it raises where batch and scalars differ."""
    checked = check_vector_env(
        lambda n, mode: CzVectorEnv(n, autoreset_mode=mode, **settings), lambda: CzEnv(**settings), **options
    )
    assert checked.by_slot
    return checked


@pytest.mark.parametrize("observation", ["measured", "history", "state"])
def test_the_checkers_of_gymnasium_and_stable_baselines3_on_every_scenario(observation):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for scenario in SCENARIOS:
            env = gym.make("Cz-v0", scenario=scenario, observation=observation, **SHORT)
            check_with_gymnasium(env.unwrapped)
            check_with_sb3(env)


@pytest.mark.parametrize("mode", list(AutoresetMode))
@pytest.mark.parametrize(
    "settings",
    [
        {"scenario": "puller", "observation": "history"},
        {"scenario": "hard", "observation": "state", "model": 0.2},
        {"scenario": "sensor-fault", "observation": "measured"},
        {"scenario": "all", "observation": "history", "action": "smooth", "horizon": 1800.0},
        {"scenario": {"randomized": 1.0, "puller": 1.0}, "info": "lean"},
        {"scenario": "hard", "action_repeat": 3, "action": "direct", "info": "lean"},
    ],
    ids=["puller", "hard", "sensor-fault", "all", "lean", "repeat"],
)
def test_the_native_batch_is_a_vector_of_scalars(settings, mode):
    settings = {"info": "all", **SHORT, **settings}
    checked = conforming(settings, steps=60, mode=mode)
    assert checked.episodes > checked.failures > 2
    assert checked.held > (2000 if settings["info"] == "all" else 700)


@pytest.mark.parametrize("mode", AutoresetMode)
def test_a_batch_of_images_is_a_vector_of_scalars(mode):
    settings = {"scenario": "sensor-fault", "observation": "camera", **SHORT, "horizon": 180.0, "info": "all"}
    checked = conforming(settings, mode=mode, num_envs=2, steps=5, random_start=False)
    assert checked.episodes > 1
    assert checked.held > 90


ALIKE = {("only-sensor", "state"), ("sensor-fault", "camera")}
"""Two first images of "sensor-fault" may both be black, so images do not tell its episodes apart."""


@pytest.mark.slow
@pytest.mark.parametrize("observation", [*OBSERVATIONS, "camera"])
@pytest.mark.parametrize("scenario", SCENARIOS)
def test_every_scenario_and_observation_conforms(scenario, observation):
    """Long steps and short episodes, so that many end; images, which are slow, for fewer steps."""
    images = observation == "camera"
    settings = {"scenario": scenario, "observation": observation, **SHORT, "horizon": 180.0 if images else 1200.0}
    at_random = scenario in {"randomized", "hard", "sensor-fault", "puller", "only-sensor"}
    random_start = at_random and (scenario, observation) not in ALIKE
    for mode in AutoresetMode:
        conforming(settings, mode=mode, steps=4 if images else 50, random_start=random_start)


def test_a_thread_that_is_late_is_not_waited_for():
    env, alone = (CzVectorEnv(512, "nominal", threads=threads) for threads in (2, 1))
    env.reset(seed=0)
    alone.reset(seed=0)
    action = np.zeros((512, 2))
    env.step(action)
    alone.step(action)
    busy = threading.Event()
    pool = env._batch._pool
    assert pool is not None
    held = pool.submit(busy.wait, 60.0)
    np.testing.assert_array_equal(env.step(action)[0], alone.step(action)[0])
    assert not held.done()
    busy.set()
    env.close()


def test_a_large_batch_holds_the_same_slots_as_a_small_one(rng):
    """Two slots with violent actions, one with small ones: episodes end by failure and by time."""
    large, small = CzVectorEnv(600, horizon=300.0), CzVectorEnv(3, horizon=300.0)
    first = large.reset(seed=list(range(100, 700)))[0][500:503]
    np.testing.assert_array_equal(first, small.reset(seed=[600, 601, 602])[0])
    noise = rng.uniform(-0.4, 0.4, (70, 3, 2)) + np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 0.0]])
    for action in noise.astype(np.float32):
        wide = np.zeros((600, 2), np.float32)
        wide[500:503] = action
        np.testing.assert_array_equal(large.step(wide)[0][500:503], small.step(action)[0])


def test_a_masked_reset_of_a_batch_with_padded_info_keeps_the_other_slots():
    env = CzVectorEnv(64, horizon=600.0)
    env.reset(seed=0)
    before = env.step(np.full((64, 2), 0.1))
    mask = np.arange(64) % 3 == 0
    observation, info = env.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal(observation[~mask], before[0][~mask])
    assert not np.array_equal(observation[mask], before[0][mask])
    assert info["r_c"].shape == (64,)
    assert info["_r_c"].tolist() == mask.tolist()
    np.testing.assert_array_equal(env._out.info[0, :64][~mask], before[4]["r_c"][~mask])


def test_no_step_while_an_episode_is_over():
    env = CzVectorEnv(3, autoreset_mode="Disabled", horizon=10.0)
    env.reset(seed=0)
    env.step(np.zeros((3, 2)))
    env.reset(options={"reset_mask": np.array([True, False, False])})
    env.step(np.zeros((3, 2)))
    last = pickle.dumps(env.get_state())
    with pytest.raises(ResetNeeded, match="2 episodes are over"):
        env.step(np.zeros((3, 2)))
    assert pickle.dumps(env.get_state()) == last


@pytest.mark.skipif(sys.platform == "win32", reason="Windows cannot fork")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_forked_child_steps_on_threads_of_its_own():
    env = CzVectorEnv(512, "nominal", threads=2)
    env.reset(seed=0)
    env.step(np.zeros((512, 2)))
    child = multiprocessing.get_context("fork").Process(target=env.step, args=(np.zeros((512, 2)),))
    child.start()
    child.join(timeout=60)
    ended, code = not child.is_alive(), child.exitcode
    child.kill()
    env.close()
    assert (ended, code) == (True, 0)


def masked(mask):
    env = CzVectorEnv(2, autoreset_mode="Disabled")
    env.reset(seed=0)
    env.reset(options={"reset_mask": mask})


@pytest.mark.parametrize(
    ("call", "error", "says"),
    [
        (lambda: masked([True, False]), TypeError, "reset_mask"),
        (lambda: masked(np.array([1, 0])), TypeError, "reset_mask"),
        (lambda: masked(np.array([False, False])), ValueError, "reset_mask"),
        (lambda: masked(np.array([True])), ValueError, "reset_mask"),
        (lambda: CzVectorEnv(0), ValueError, "num_envs must be a positive whole number"),
        (lambda: CzVectorEnv(2.5), ValueError, "num_envs must be a positive whole number"),
        (lambda: CzVectorEnv(threads=0), ValueError, "threads must be a positive whole number"),
        (lambda: CzVectorEnv(autoreset_mode="never"), ValueError, "not a valid AutoresetMode"),
        (lambda: CzVectorEnv(render_mode="human"), ValueError, "a batch does not render: render_mode must be None"),
        (lambda: CzVectorEnv(2).reset(seed=[1, 2, 3]), ValueError, "expected 2 seeds"),
    ],
)
def test_what_a_batch_cannot_mean_is_refused(call, error, says):
    with pytest.raises(error, match=says):
        call()
    CzVectorEnv.__new__(CzVectorEnv).close_extras()  # Gymnasium up to 1.1 does so when one is forgotten


def test_a_single_seed_s_crystals_are_none_of_any_split_s():
    """Slots of a training seed near the first validation seed meet no crystal of validation or test."""
    batch, seed = CzVectorEnv(3), VALIDATION_SEEDS[0] - 1
    first, _ = batch.reset(seed=seed)
    assert all(each >= 2**128 for each in batch.np_random_seed)
    for own, shown in zip(batch.np_random_seed, first, strict=True):
        np.testing.assert_array_equal(CzEnv().reset(seed=own)[0], shown)
    listed, _ = batch.reset(seed=[seed, seed + 1, seed + 2])
    assert not (first[:, None] == listed[None]).all(axis=-1).any()
    assert not (first == batch.reset(seed=seed + 1)[0]).all(axis=-1).any()
    again, _ = batch.reset(seed=seed)
    np.testing.assert_array_equal(again, first)


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


def test_vectors_of_others_pass_or_fail_for_good_reasons():
    """Gymnasium's vector of CartPoles conforms, slot by slot; so does its native one, whose slots share a stream."""

    def cart_pole():
        return gym.make("CartPole-v1")

    checked = check_vector_env(lambda n, mode: SyncVectorEnv([cart_pole] * n, autoreset_mode=mode), cart_pole)
    assert (checked.by_slot, checked.failures > 9) == (True, True)
    checked = check_vector_env(lambda n, _: gym.make_vec("CartPole-v1", n, "vector_entry_point"), cart_pole)
    assert (checked.by_slot, checked.failures > 9) == (False, True)

    def wider(n, _):
        native = gym.make_vec("CartPole-v1", n, "vector_entry_point")
        return TransformObservation(native, lambda shown: shown.astype(np.float64))

    with pytest.raises(NotConforming, match=r"^\[NextStep\] reset: the observation is not in observation_space"):
        check_vector_env(wider, cart_pole)


def test_a_scalar_form_that_does_not_repeat_itself_is_named():
    class Restless(Walk):
        def step(self, action):
            self.x = self.x + np.random.default_rng().normal(size=2)
            return super().step(action)

    with pytest.raises(NotConforming, match="step 0: the scalar form differs from itself with the same seed"):
        check_vector_env(lambda n, mode: SyncVectorEnv([Restless] * n, autoreset_mode=mode), Restless, steps=40)


@pytest.mark.parametrize("mode", AutoresetMode)
def test_infos_and_rounding_may_be_left_out_of_a_comparison(mode):
    def rounded(o, r, ended, late, infos):
        return o, r * (1.0 + 1e-9), ended, late, {**infos, "more": np.zeros(3)}

    def timed(*result):
        return *result[:4], {**result[4], "time": np.full(3, perf_counter())}

    with pytest.raises(NotConforming, match="reward of slot"):
        check_vector_env(lambda n, mode: vector(n, mode, step=rounded), Walk, steps=40, mode=mode)
    check_vector_env(lambda n, mode: vector(n, mode, step=rounded), Walk, steps=40, mode=mode, infos=False, rtol=1e-6)
    check_vector_env(lambda n, mode: vector(n, mode, step=timed), Walk, steps=40, mode=mode, infos=False)


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
