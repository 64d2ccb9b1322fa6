from __future__ import annotations

import copy
import math
import multiprocessing
import pickle
import threading
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import InvalidAction, ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from cz_gym import CzEnv, CzVectorEnv

MODES = list(AutoresetMode)
N = 5


def actions(steps: int, n: int = N) -> np.ndarray:
    """Noisy, for some slots violent: episodes end by failure and by time."""
    rng = np.random.default_rng(1)
    noise = rng.uniform(-0.4, 0.4, (steps, n, 2)).astype(np.float32)
    noise[:, 0, 0] += 1.0
    noise[:, 1, 0] -= 1.0
    return noise


def equal(one: Any, other: Any, where: str = "") -> None:
    """Deep equality of what two vector environments return: values, dtypes, keys, masks."""
    if isinstance(one, dict):
        assert set(one) == set(other), where
        for key in one:
            equal(one[key], other[key], f"{where}/{key}")
        return
    one, other = np.asarray(one), np.asarray(other)
    assert (one.shape, one.dtype) == (other.shape, other.dtype), where
    if one.dtype == object:
        for a, b in zip(one, other, strict=True):
            assert (a is None) == (b is None), where
            if a is not None:
                equal(a, b, where)
    else:
        np.testing.assert_array_equal(one, other, err_msg=where)


def masked_equal(one: dict[str, Any], other: dict[str, Any]) -> None:
    """Infos agree where their masks say there is something."""
    assert set(one) == set(other)
    for key in one:
        if key.startswith("_"):
            np.testing.assert_array_equal(one[key], other[key], err_msg=key)
        elif isinstance(one[key], dict):
            masked_equal(one[key], other[key])
        else:
            equal(one[key], other[key], key)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    ("scenario", "observation"),
    [("randomized", "measured"), ("sensor-fault", "history"), ("puller", "measured"), ("hard", "state")],
)
def test_equals_gymnasiums_vector_of_scalars_bit_for_bit(mode: AutoresetMode, scenario: str, observation: str) -> None:
    arguments: dict[str, Any] = {
        "scenario": scenario, "observation": observation, "control_interval": 20.0, "horizon": 600.0, "model": 0.2,
    }  # fmt: skip
    ours = CzVectorEnv(N, autoreset_mode=mode, **arguments)
    theirs = SyncVectorEnv([lambda: CzEnv(**arguments)] * N, autoreset_mode=mode)
    results = ours.reset(seed=40), theirs.reset(seed=40)
    equal(results[0][0], results[1][0])
    masked_equal(results[0][1], results[1][1])
    ends = np.zeros(2, int)
    for action in actions(140):
        one, other = ours.step(action), theirs.step(action)
        for name, a, b in zip(("observation", "reward", "terminated", "truncated"), one, other, strict=False):
            equal(a, b, name)
        masked_equal(one[4], other[4])
        ends += one[2].sum(), one[3].sum()
        over = one[2] | one[3]
        if mode == AutoresetMode.DISABLED and over.any():
            reset, again = (env.reset(options={"reset_mask": over.copy()}) for env in (ours, theirs))
            equal(reset[0], again[0])
            masked_equal(reset[1], again[1])
    assert ends.min() > 5, "both kinds of end must have happened"
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.metadata["autoreset_mode"] == mode


def test_threads_do_not_change_results() -> None:
    n, rng = 520, np.random.default_rng(2)
    batches = [CzVectorEnv(n, "puller", observation="history", horizon=60.0, threads=threads) for threads in (1, 2)]
    assert [batch._batch._parts for batch in batches] == [1, 2]
    one, other = (batch.reset(seed=7) for batch in batches)
    equal(one[0], other[0])
    for _ in range(30):
        action = rng.uniform(-1, 1, (n, 2)).astype(np.float32)
        one, other = (batch.step(action) for batch in batches)
        for a, b in zip(one, other, strict=True):
            equal(a, b)
    for batch in batches:
        batch.close()
        batch.close()


def test_a_thread_that_is_late_is_not_waited_for() -> None:
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
    equal(env.step(action)[0], alone.step(action)[0])
    assert not held.done()
    busy.set()
    env.close()


def test_a_large_batch_holds_the_same_slots_as_a_small_one() -> None:
    large, small = CzVectorEnv(600, horizon=300.0), CzVectorEnv(3, horizon=300.0)
    first = large.reset(seed=100)[0][500:503]
    np.testing.assert_array_equal(first, small.reset(seed=600)[0])
    for action in actions(70, 3):
        wide = np.zeros((600, 2), np.float32)
        wide[500:503] = action
        np.testing.assert_array_equal(large.step(wide)[0][500:503], small.step(action)[0])


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("observation", ["measured", "history", "state"])
def test_nothing_returned_is_written_again(mode: AutoresetMode, observation: str) -> None:
    env = CzVectorEnv(N, observation=observation, control_interval=20.0, horizon=600.0, autoreset_mode=mode)
    kept = [env.reset(seed=0)]
    copies = [copy.deepcopy(kept[0])]
    for action in actions(45):
        result = env.step(action)
        kept.append(result)
        copies.append(copy.deepcopy(result))
        over = result[2] | result[3]
        if mode == AutoresetMode.DISABLED and over.any():
            result = env.reset(options={"reset_mask": over})
            kept.append(result)
            copies.append(copy.deepcopy(result))
    for one, other in zip(kept, copies, strict=True):
        for a, b in zip(one, other, strict=True):
            equal(a, b)


@pytest.mark.parametrize("mode", MODES)
def test_what_is_written_into_a_result_changes_nothing_inside(mode: AutoresetMode) -> None:
    plain, spoilt = (CzVectorEnv(N, control_interval=20.0, horizon=600.0, autoreset_mode=mode) for _ in range(2))
    for env in (plain, spoilt):
        env.reset(seed=0)
    for action in actions(45):
        expected, result = plain.step(action), spoilt.step(action)
        for a, b in zip(expected, result, strict=True):
            equal(a, b)
        over = result[2] | result[3]
        for array in result[:4]:
            array[...] = 1
        for value in result[4].values():
            if isinstance(value, np.ndarray) and value.dtype != object:
                value[...] = 1
        if mode == AutoresetMode.DISABLED and over.any():
            shown, again = (env.reset(options={"reset_mask": over.copy()}) for env in (plain, spoilt))
            equal(shown[0], again[0])


def test_a_masked_reset_of_a_batch_with_padded_info_keeps_the_other_slots() -> None:
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


def test_the_reset_mask_is_copied_and_the_rest_goes_on() -> None:
    env = CzVectorEnv(3, autoreset_mode="Disabled", horizon=10.0)
    env.reset(seed=0)
    before, *_ = env.step(np.zeros((3, 2)))
    mask = np.array([True, False, False])
    shown, info = env.reset(options={"reset_mask": mask})
    mask[:] = True
    assert info["_r_c"].tolist() == [True, False, False]
    np.testing.assert_array_equal(shown[1:], before[1:])
    shown, _, _, truncated, _ = env.step(np.zeros((3, 2)))
    assert truncated.tolist() == [False, True, True]
    last, shown_last = env.get_state(), shown.copy()
    with pytest.raises(ResetNeeded, match="2 episodes are over"):
        env.step(np.zeros((3, 2)))
    assert pickle.dumps(env.get_state()) == pickle.dumps(last)
    kept, _ = env.reset(options={"reset_mask": np.array([False, True, True])})
    np.testing.assert_array_equal(kept[0], shown_last[0])


@pytest.mark.parametrize(
    "options",
    [
        {"scenario": "nonsense"},
        {"state": 3},
        {"state": []},
        {"state": [1, 2, 3]},
        {"typo": 1},
        {"scenario": "hard", "state": []},
        3,
        "abc",
    ],
)
def test_a_refused_reset_changes_nothing(options: Any) -> None:
    env = CzVectorEnv(3)
    env.reset(seed=0)
    env.step(np.zeros((3, 2)))
    before = pickle.dumps(env.get_state())
    with pytest.raises(ValueError, match=r"unknown|expected 3 states|exclude each other|must be a dict"):
        env.reset(seed=5, options=options)
    assert pickle.dumps(env.get_state()) == before


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_forked_child_steps_on_threads_of_its_own() -> None:
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


@pytest.mark.parametrize(
    ("mask", "error"),
    [
        ([True, False], TypeError),
        (np.array([1, 0]), TypeError),
        (np.array([False, False]), ValueError),
        (np.array([True]), ValueError),
    ],
)
def test_bad_masks_are_refused(mask: Any, error: type[Exception]) -> None:
    env = CzVectorEnv(2, autoreset_mode="Disabled")
    env.reset(seed=0)
    with pytest.raises(error, match="reset_mask"):
        env.reset(options={"reset_mask": mask})


def test_each_slot_draws_from_its_own_seed() -> None:
    by_list = CzVectorEnv(3).reset(seed=[5, 9, 6])[0]
    alone = [CzEnv().reset(seed=seed)[0] for seed in (5, 9, 6)]
    np.testing.assert_array_equal(by_list, alone)
    np.testing.assert_array_equal(CzVectorEnv(3).reset(seed=5)[0][[0, 1]], np.array(alone)[[0, 2]])
    with pytest.raises(ValueError, match="expected 3 seeds"):
        CzVectorEnv(3).reset(seed=[1, 2])


def test_seeds_are_remembered() -> None:
    env = CzVectorEnv(2)
    env.reset(seed=4)
    assert env.np_random_seed == (4, 5)


@pytest.mark.parametrize(
    "action", [np.zeros(2), np.zeros((2, 3)), np.full((2, 2), math.nan), "up", None, [[0.0, 0.0], [0.0]]]
)
def test_bad_actions_are_refused(action: Any) -> None:
    env = CzVectorEnv(2)
    env.reset(seed=0)
    with pytest.raises(InvalidAction, match="actions must") as refusal:
        env.step(action)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    "arguments", [{"num_envs": 0}, {"num_envs": 2.5}, {"threads": 0}, {"threads": "two"}, {"autoreset_mode": "never"}]
)
def test_bad_arguments_are_refused(arguments: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"must be|not a valid"):
        CzVectorEnv(**arguments)


def test_stepping_needs_a_reset() -> None:
    with pytest.raises(ResetNeeded):
        CzVectorEnv(2).step(np.zeros((2, 2)))


def test_made_by_gymnasium() -> None:
    env = gym.make_vec("Cz-v0", num_envs=2, vectorization_mode="vector_entry_point", scenario="hard", horizon=50.0)
    shown, _ = env.reset(seed=3)
    np.testing.assert_array_equal(shown[1], gym.make("Cz-v0", scenario="hard", horizon=50.0).reset(seed=4)[0])
    env.close()


def test_an_environment_that_was_refused_can_be_closed() -> None:
    """Gymnasium up to 1.1 does so when it is forgotten."""
    CzVectorEnv.__new__(CzVectorEnv).close_extras()
