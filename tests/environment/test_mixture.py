"""Mixtures of scenarios: each episode is drawn from one of them, and is what it is in that scenario alone."""

import math
import pickle
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

from cz_gym import SCENARIOS, CzEnv, CzVectorEnv
from cz_gym.config import make_config
from cz_gym.engine.batch import first_key
from cz_gym.episodes.draw import MIXTURE_STREAM
from cz_gym.episodes.scenarios import ALL, find_distribution

MIX = {"puller": 1.0, "randomized": 2.0, replace(SCENARIOS["hard"], name="mine"): 1.0}
MEMBERS = find_distribution(MIX).scenarios
BY_NAME = {scenario.name: scenario for scenario in MEMBERS}
SHORT = {"horizon": 40.0, "observation": "history", "action": "smooth", "info": "all"}


def test_all_is_every_random_row_of_the_benchmark():
    shares = {each.name: share for each, share in zip(ALL.scenarios, ALL.shares, strict=True)}
    assert shares == {"hard": 0.175, "hot-zone": 0.175, "puller": 0.175, "randomized": 0.3, "sensor-fault": 0.175}
    assert find_distribution("all") is ALL
    assert find_distribution({name: 2.0 * share for name, share in shares.items()}) == ALL


def test_shares_order_and_unit_of_equal_mixtures_do_not_matter():
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


def test_shares_of_two_thousand_episodes_on_a_stream_of_their_own():
    _, infos = CzVectorEnv(2000, "all").reset(seed=5)
    names, upto = [each.name for each in ALL.scenarios], np.cumsum(ALL.shares)
    for i in range(2000):
        stream = np.random.SeedSequence(list(first_key(5 + i)), spawn_key=(MIXTURE_STREAM,))
        u = np.random.Generator(np.random.PCG64(stream)).random()
        assert infos["scenario"][i] == names[int(np.searchsorted(upto, u, side="right"))]
    for name, share in zip(names, ALL.shares, strict=True):
        assert np.mean(infos["scenario"] == name) == pytest.approx(share, abs=4 * math.sqrt(share / 2000))


@pytest.mark.parametrize("model", [None, "I"])
def test_an_episode_is_bit_for_bit_that_of_its_scenario_alone(model):
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
        for action in np.random.default_rng(4).uniform(-1.1, 1.1, (8, 2)):
            found, (seen, reward, *ends, told) = env.step(action), alone[name].step(action)
            assert found[4].pop("scenario") == name
            np.testing.assert_array_equal(found[0], seen)
            np.testing.assert_array_equal(found[4].pop("state"), told.pop("state"))
            assert (found[1], *found[2:]) == (reward, *ends, told)
    assert met == set(BY_NAME)


def test_an_option_draws_one_episode_from_a_scenario_or_a_mixture():
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
