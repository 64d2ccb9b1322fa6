import copy
import dataclasses
import pickle
from itertools import product

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from cz_gym import CzEnv, CzVectorEnv, Parameters

ACTIONS = np.random.default_rng(0).uniform(-0.3, 0.3, (100, 2)).astype(np.float32)


def run(env, steps, first=0):
    """Everything an environment says, resetting when it must."""
    said = []
    for k in range(first, first + steps):
        observation, gained, terminated, truncated, info = env.step(ACTIONS[k])
        said.append((observation.tobytes(), gained, terminated, truncated, sorted(info.items(), key=str)))
        if terminated or truncated:
            observation, info = env.reset()
            said.append((observation.tobytes(), sorted(info.items(), key=str)))
    return [repr(row) for row in said]


@pytest.mark.parametrize(
    ("scenario", "observation"),
    [*product(("all", "sensor-fault", "puller"), ("measured", "history", "state")), ("sensor-fault", "camera")],
)
def test_a_saved_state_continues_bit_for_bit(scenario, observation):
    """A state is a value; a reset from it shows its last sample."""
    env, other = (CzEnv(scenario, observation=observation, horizon=200.0) for _ in range(2))
    env.reset(seed=9)
    run(env, 24)
    shown, *_, info = env.step(ACTIONS[24])
    state = env.get_state()
    saved, expected = pickle.dumps(state), run(env, 60, 25)
    assert pickle.dumps(state) == saved
    again, told = other.reset(options={"state": state})
    np.testing.assert_array_equal(again, shown)
    assert repr(told) == repr(info)
    assert run(other, 60, 25) == expected
    for each in (env, other):
        each.set_state(pickle.loads(saved))
        assert run(each, 60, 25) == expected


def test_state_of_a_finished_episode_stays_finished():
    env, other = CzEnv("nominal", horizon=5.0), CzEnv("nominal", horizon=5.0)
    env.reset(seed=0)
    env.step(ACTIONS[0])
    other.set_state(env.get_state())
    with pytest.raises(Exception, match="episode is over"):
        other.step(ACTIONS[0])


def test_states_travel_between_scalar_and_vector():
    scalars = [CzEnv("all", horizon=100.0, info="all") for _ in range(3)]
    for seed, env in enumerate(scalars):
        env.reset(seed=seed)
        for action in ACTIONS[:7]:
            env.step(action)
    batch = CzVectorEnv(3, "all", horizon=100.0, info="all")
    batch.set_state([env.get_state() for env in scalars])
    for action in ACTIONS[7:12]:
        observation, gained, _, _, info = batch.step(np.tile(action, (3, 1)))
        for i, env in enumerate(scalars):
            alone, alone_gained, _, _, alone_info = env.step(action)
            np.testing.assert_array_equal(observation[i], alone)
            assert gained[i] == alone_gained
            assert (info["h_c"][i], info["scenario"][i]) == (alone_info["h_c"], alone_info["scenario"])
    back = CzEnv("all", horizon=100.0, info="all")
    back.set_state(pickle.loads(pickle.dumps(batch.get_state()))[1])
    assert run(back, 40, 12) == run(scalars[1], 40, 12)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"scenario": "hard"}, "scenario 'randomized' (.*), not 'hard' "),
        ({"model": "I"}, r"mix .0.0, 1.0., not .1.0, 1.0."),
        ({"observation": "state"}, "observation history, not state"),
        ({"action": "direct"}, "action smooth, not direct"),
        ({"control_interval": 10.0}, "control interval 5.0, not 10.0"),
        ({"horizon": 100.0}, "horizon 10800.0, not 100.0"),
        ({"parameters": Parameters(dH=1.7e6)}, "plant [0-9a-f]{16}, not [0-9a-f]{16}"),
    ],
)
@pytest.mark.parametrize("form", [CzEnv, CzVectorEnv])
def test_a_state_of_other_settings_is_refused_with_the_name_of_the_setting(form, arguments, says):
    env = form()
    env.reset(seed=0)
    with pytest.raises(ValueError, match=f"other settings than this environment's: {says}") as refusal:
        form(**arguments).reset(options={"state": env.get_state()})
    assert "\n" not in str(refusal.value)


def with_slot(**changes):
    return lambda state: dataclasses.replace(state, slot=dataclasses.replace(state.slot, **changes))


def with_random(random):
    return lambda state: dataclasses.replace(state, random=random)


def at_sample(k):
    return lambda state: state.slot.slot.__setitem__("k", k) or state


@pytest.mark.parametrize(
    ("damaged", "says"),
    [
        (with_slot(identity=None), "saved by another version of cz_gym"),
        (with_slot(identity=CzEnv().config.identity._replace(version=7)), "version 7, not 0"),
        (with_slot(slot=np.zeros((), [("x", float)])), "its slot does not fit"),
        (with_slot(history=[1, 2]), "its history does not fit"),
        (with_slot(history=np.zeros((0, 4), np.float32)), "its history does not fit"),
        (with_slot(frames=np.zeros((1, 2))), "its frames does not fit"),
        (with_random({}), "random stream is not one of PCG64"),
        (with_random(None), "random stream is not one of PCG64"),
        (with_random({"bit_generator": "MT19937"}), "random stream is not one of PCG64"),
        (with_random({"bit_generator": "PCG64", "state": 3}), "random stream is not one of PCG64"),
        (at_sample(-1), "damaged: sample -1 of 2160"),
        (at_sample(2161), "damaged: sample 2161 of 2160"),
        (lambda state: {"x": 1}, "get_state"),
    ],
)
def test_a_damaged_state_is_refused_and_changes_nothing(damaged, says):
    env = CzEnv()
    env.reset(seed=0)
    before = pickle.dumps(env.get_state())
    with pytest.raises(ValueError, match=says):
        env.set_state(damaged(copy.deepcopy(env.get_state())))
    assert pickle.dumps(env.get_state()) == before


OTHER = CzEnv("nominal")
OTHER.reset(seed=0)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (3, "must be a dict, not"),
        ({"seed": 3}, "unknown reset option"),
        ({"scenario": "nonsense"}, "unknown scenario"),
        ({"state": 3}, "get_state|expected 2 states"),
        ({"state": OTHER.get_state()}, "other settings|expected 2 states"),
        ({"scenario": "hard", "state": OTHER.get_state()}, "exclude each other"),
    ],
)
@pytest.mark.parametrize("form", [CzEnv, lambda: CzVectorEnv(2)])
def test_a_refused_reset_changes_nothing(form, options, says):
    env = form()
    env.reset(seed=0)
    before = pickle.dumps(env.get_state())
    with pytest.raises(ValueError, match=says):
        env.reset(seed=5, options=options)
    assert pickle.dumps(env.get_state()) == before


@pytest.mark.parametrize(
    ("name", "value"), [("r_c", np.nan), ("h_c", np.nan), ("T_b", np.nan), ("h_c", 0.0), ("h_c", -1e-3)]
)
def test_a_broken_state_terminates(name, value):
    """A state that no crystal can have ends the episode as a failure, without an exception."""
    env = CzEnv("nominal")
    env.reset(seed=0)
    state = copy.deepcopy(env.get_state())
    state.slot.slot["x"][name] = value
    env.set_state(state)
    observation, gained, terminated, truncated, _ = env.step(ACTIONS[0])
    assert (terminated, truncated) == (True, False)
    if not np.isnan(value):
        assert gained <= 1.0 - 1000.0
        assert np.isfinite(observation).all()


@pytest.mark.parametrize("steps", [0, 12, 55])
def test_a_pickled_environment_goes_on_bit_for_bit(steps):
    """Never reset, in an episode, and after the first one; wrappers and all."""
    env = gym.make("Cz-v0", scenario="all", observation="history", action="smooth", horizon=200.0, info="all")
    if steps:
        env.reset(seed=4)
        run(env.unwrapped, steps)
    env.action_space.seed(6)
    other = pickle.loads(pickle.dumps(env))
    assert other.spec == env.spec
    assert repr(other.action_space.sample()) == repr(env.action_space.sample())
    for each in (env, other):
        if not steps:
            each.reset(seed=5)
    assert run(other.unwrapped, 40, steps) == run(env.unwrapped, 40, steps)


@pytest.mark.parametrize("mode", list(AutoresetMode)[:2])
def test_a_pickled_batch_goes_on_bit_for_bit(mode):
    """With slots that are over and wait for their next episode."""
    batch = CzVectorEnv(3, "all", horizon=100.0, autoreset_mode=mode, info="all")
    for steps in (0, 20, 20):
        if steps == 0:
            batch = pickle.loads(pickle.dumps(batch))
            batch.reset(seed=7)
        for k in range(steps):
            batch.step(np.tile(ACTIONS[k], (3, 1)))
        other = pickle.loads(pickle.dumps(batch))
        assert other.np_random_seed == batch.np_random_seed
        assert repr(other.action_space.sample()) == repr(batch.action_space.sample())
        for k in range(25):
            one, two = batch.step(np.tile(ACTIONS[k], (3, 1))), other.step(np.tile(ACTIONS[k], (3, 1)))
            assert repr(one) == repr(two)
