"""Mixtures of scenarios: each episode is drawn from one of them, and is what it is in that scenario alone."""

import math
import pickle
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from cz_gym import SCENARIOS, CzEnv, CzVectorEnv
from cz_gym.config import make_config
from cz_gym.differentiable import DifferentiableBatch
from cz_gym.engine.batch import first_key
from cz_gym.episodes.record import MIXTURE_STREAM
from cz_gym.episodes.scenario import Scenario
from cz_gym.episodes.scenarios import ALL, find_distribution

MIX: dict[str | Scenario, float] = {"puller": 1.0, "randomized": 2.0, replace(SCENARIOS["hard"], name="mine"): 1.0}
MEMBERS = find_distribution(MIX).scenarios
BY_NAME = {scenario.name: scenario for scenario in MEMBERS}
SHORT: dict[str, Any] = {"horizon": 40.0, "observation": "history", "action": "smooth", "info": "all"}


def actions(n: int, steps: int = 30) -> np.ndarray:
    return np.random.default_rng(4).uniform(-1.1, 1.1, (steps, n, 2))


def test_all_is_every_random_row_of_the_benchmark() -> None:
    shares = {each.name: share for each, share in zip(ALL.scenarios, ALL.shares, strict=True)}
    assert shares == {"hard": 0.175, "hot-zone": 0.175, "puller": 0.175, "randomized": 0.3, "sensor-fault": 0.175}
    assert find_distribution("all") is ALL
    assert find_distribution({name: 2.0 * share for name, share in shares.items()}) == ALL


def test_shares_order_and_unit_of_equal_mixtures_do_not_matter() -> None:
    one, other = find_distribution({"hard": 1, "puller": 3}), find_distribution({"puller": 75.0, "hard": 25.0})
    assert (one, one.hash, one.name) == (other, other.hash, "0.25 hard + 0.75 puller")
    assert one.hash != find_distribution({"hard": 1, "puller": 2}).hash
    assert find_distribution(one) is one
    config = make_config(one)
    assert (config.scenario, config.mix) == (one, (0.0, 1.0))
    assert make_config({"hard": 1, "puller": 2}).hash != config.hash != make_config("hard").hash
    assert not one.deterministic
    assert find_distribution({"nominal": 1.0}).deterministic
    assert make_config("hard").sole_scenario is SCENARIOS["hard"]
    with pytest.raises(ValueError, match="one scenario, not the mixture"):
        config.sole_scenario  # noqa: B018


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"randomised": 1.0}, "unknown scenario 'randomised': did you mean 'randomized'"),
        ("al", "unknown scenario 'al'.* all"),
        ({"hard": 0.0}, "positive numbers: that of 'hard' is 0.0"),
        ({"hard": -1}, "positive numbers"),
        ({"hard": math.nan}, "positive numbers"),
        ({"hard": math.inf}, "positive numbers"),
        ({"hard": True}, "positive numbers"),
        ({"hard": "much"}, "positive numbers"),
        ({}, "at least one scenario"),
        ({"hard": 1, SCENARIOS["hard"]: 1}, "'hard' is there twice"),
        ({"all": 1.0}, "one scenario, not the mixture"),
        ({"hard-I": 1.0}, "is a row of the benchmark"),
        (["hard"], "unknown scenario .* dict of scenarios and their shares"),
    ],
)
def test_bad_mixtures_are_refused_in_one_line(given: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message) as refusal:
        CzEnv(given)
    assert "\n" not in str(refusal.value)


def test_shares_of_two_thousand_episodes_on_a_stream_of_their_own() -> None:
    _, infos = CzVectorEnv(2000, "all").reset(seed=5)
    names, upto = [each.name for each in ALL.scenarios], np.cumsum(ALL.shares)
    for i in range(2000):
        stream = np.random.SeedSequence(list(first_key(5 + i)), spawn_key=(MIXTURE_STREAM,))
        u = np.random.Generator(np.random.PCG64(stream)).random()
        assert infos["scenario"][i] == names[int(np.searchsorted(upto, u, side="right"))]
    for name, share in zip(names, ALL.shares, strict=True):
        assert np.mean(infos["scenario"] == name) == pytest.approx(share, abs=4 * math.sqrt(share / 2000))


@pytest.mark.parametrize("model", [None, "I"])
def test_an_episode_is_bit_for_bit_that_of_its_scenario_alone(model: str | None) -> None:
    """Every re-drawn episode, too: the environments alone are reset with the same seed as often as the mixture was."""
    env, alone = CzEnv(MIX, model, **SHORT), {name: CzEnv(one, model, **SHORT) for name, one in BY_NAME.items()}
    met = set()
    for episode in range(12):
        seed = 7 if episode == 0 else None
        expected = {name: each.reset(seed=seed) for name, each in alone.items()}
        observation, info = env.reset(seed=seed)
        name = info.pop("scenario")
        met.add(name)
        np.testing.assert_array_equal(observation, expected[name][0])
        for action in actions(1, 8):
            found, (seen, reward, *ends, told) = env.step(action[0]), alone[name].step(action[0])
            assert found[4].pop("scenario") == name
            np.testing.assert_array_equal(found[0], seen)
            np.testing.assert_array_equal(found[4].pop("state"), told.pop("state"))
            assert (found[1], *found[2:]) == (reward, *ends, told)
    assert met == set(BY_NAME)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize("info", ["lean", "all"])
def test_the_batch_equals_scalar_environments(mode: AutoresetMode, info: str) -> None:
    n, settings = 6, {**SHORT, "info": info}
    one = CzVectorEnv(n, MIX, autoreset_mode=mode, **settings)
    many = SyncVectorEnv([lambda: CzEnv(MIX, **settings)] * n, autoreset_mode=mode)
    pairs, finals = [(one.reset(seed=3), many.reset(seed=3))], 0
    pairs += [(one.step(action), many.step(action)) for action in actions(n)]
    for mine, theirs in pairs:
        for a, b in zip(mine[:-1], theirs[:-1], strict=True):
            np.testing.assert_array_equal(a, b)
        assert mine[-1].keys() == theirs[-1].keys()
        both = [(mine[-1], theirs[-1])]
        if "final_info" in mine[-1]:
            both.append((mine[-1]["final_info"], theirs[-1]["final_info"]))
            finals += 1
        for ours, its in both:
            np.testing.assert_array_equal(ours["scenario"], its["scenario"])
            np.testing.assert_array_equal(ours["_scenario"], its["_scenario"])
            assert ours["scenario"].dtype == object
    assert bool(finals) == (mode == AutoresetMode.SAME_STEP)
    assert len({tuple(mine[-1]["scenario"]) for mine, _ in pairs}) > 2, "later steps leave returned names alone"


@pytest.mark.parametrize("mask", [[True, False, True], [False, True, False]])
def test_a_partial_reset_names_its_own_slots(mask: list[bool]) -> None:
    env = CzVectorEnv(3, MIX, autoreset_mode=AutoresetMode.DISABLED)
    before = env.reset(seed=1)[1]["scenario"]
    _, infos = env.reset(seed=50, options={"reset_mask": np.array(mask)})
    assert infos["_scenario"].tolist() == mask
    assert [name is not None for name in infos["scenario"]] == mask
    after = env.step(np.zeros((3, 2)))[4]["scenario"]
    for slot, again in enumerate(mask):
        assert after[slot] == (infos["scenario"][slot] if again else before[slot])


def test_saved_states_and_copies_go_on() -> None:
    env, batch = CzEnv(MIX, **SHORT), CzVectorEnv(4, MIX, **SHORT)
    _, info = env.reset(seed=11)
    batch.reset(seed=2)
    states, copied = batch.get_state(), pickle.loads(pickle.dumps(env))
    other, many = CzEnv(MIX, **SHORT), CzVectorEnv(4, MIX, **SHORT)
    _, again = other.reset(options={"state": pickle.loads(pickle.dumps(env.get_state()))})
    assert again["scenario"] == info["scenario"]
    many.set_state(states)
    for action in actions(4, 20):
        expected, found = batch.step(action), many.step(action)
        np.testing.assert_array_equal(expected[0], found[0])
        np.testing.assert_array_equal(expected[4]["scenario"], found[4]["scenario"])
    for _ in range(4):
        for action in actions(1, 8):
            steps = [each.step(action[0]) for each in (env, other, copied)]
            for seen in steps[1:]:
                np.testing.assert_array_equal(seen[0], steps[0][0])
                assert (seen[1], seen[4]["scenario"]) == (steps[0][1], steps[0][4]["scenario"])
        assert len({each.reset()[1]["scenario"] for each in (env, other, copied)}) == 1
    with pytest.raises(ValueError, match=r"under other settings.* scenario"):
        CzEnv("puller", **SHORT).set_state(env.get_state())


def test_an_option_draws_one_episode_from_a_scenario_or_a_mixture() -> None:
    env, batch = gym.make("Cz-v0", scenario=MIX), gym.make_vec("Cz-v0", 2, "vector_entry_point", scenario=MIX)
    assert env.reset(seed=1, options={"scenario": "sensor-fault"})[1]["scenario"] == "sensor-fault"
    assert batch.reset(seed=1, options={"scenario": "nominal"})[1]["scenario"].tolist() == ["nominal"] * 2
    assert env.reset()[1]["scenario"] in BY_NAME
    plain, batch = CzEnv("hard"), CzVectorEnv(2, "hard")
    assert "scenario" not in plain.reset(seed=1)[1]
    assert plain.reset(options={"scenario": {"nominal": 1.0}})[1]["scenario"] == "nominal"
    assert batch.reset(options={"scenario": {"nominal": 1.0}})[1]["scenario"].tolist() == ["nominal"] * 2
    assert pickle.loads(pickle.dumps(plain)).step(np.zeros(2))[4]["scenario"] == "nominal"
    assert plain.reset()[1]["scenario"] == "hard"


def test_the_differentiable_batch_meets_the_same_crystals() -> None:
    config = make_config(MIX, action="smooth", horizon=100.0)
    batch, seeds = DifferentiableBatch(config, 8), range(20, 28)
    _, seen = batch.reset(seeds)
    names, steps = batch.scenarios, [batch.step(action) for action in actions(8, 10)]
    assert set(names) == set(BY_NAME)
    for name in BY_NAME:
        mine = np.flatnonzero(names == name)
        alone = DifferentiableBatch(config.with_scenario(BY_NAME[name]), len(mine))
        np.testing.assert_array_equal(alone.reset([seeds[i] for i in mine])[1], seen[mine])
        for action, step in zip(actions(8, 10), steps, strict=True):
            for a, b in zip(alone.step(action[mine]), step, strict=True):
                np.testing.assert_array_equal(a, b[mine])
    batch.reset([28], [3])
    assert batch.scenarios[3] == CzEnv.from_config(config).reset(seed=28)[1]["scenario"]
    with pytest.raises(ValueError, match="latency of 5 s is longer"):
        DifferentiableBatch(make_config(MIX, control_interval=2.5), 2)
