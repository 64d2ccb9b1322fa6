"""The adapter under stable-baselines3's wrappers, against a vector of scalar environments."""

import copy
import itertools
import pickle

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from cz_gym import CzEnv, CzVectorEnv
from cz_gym.agents import OnnxPolicy
from cz_gym.agents.asymmetric import AsymmetricPolicy, AsymmetricSACPolicy, LearnState, RememberingPolicy
from cz_gym.agents.from_sb3 import save_agent
from cz_gym.body.process import BODY
from cz_gym.crystal.process import CRYSTAL
from cz_gym.sb3 import LONG, LongMeans, LongMemory, environment_steps, long_channels, make_vec_env
from cz_gym.spaces import observations
from cz_gym.support.errors import CzError

N = 3
SETTINGS = {"scenario": "hard", "control_interval": 20.0, "horizon": 400.0}


def adapter(n=N, stagger=None, **changes):
    return make_vec_env(n, stagger, **{**SETTINGS, **changes})


def test_the_adapter_equals_sb3s_own_vector_of_scalars():
    ours, theirs = adapter(), DummyVecEnv([lambda: CzEnv(**SETTINGS)] * N)
    rng = np.random.default_rng(0)
    ours.seed(theirs.seed(5))
    np.testing.assert_array_equal(ours.reset(), theirs.reset())
    failed = truncated = 0
    costs, sums = np.zeros(N), []
    for _ in range(90):
        actions = rng.uniform(-0.1, 0.1, (N, 2)).astype(np.float32)
        actions[0] = 1.0
        one, other = ours.step(actions), theirs.step(actions)
        for a, b in zip(one[:3], other[:3], strict=True):
            np.testing.assert_array_equal(a, b)
            assert a.dtype == b.dtype
        costs += [its["cost"] for its in other[3]]
        sums += [(mine["episode"]["c"], cost) for mine, cost in zip(one[3], costs, strict=True) if mine]
        costs[one[2]] = 0.0
        for done, mine, its in zip(one[2], one[3], other[3], strict=True):
            assert ("terminal_observation" in mine) == bool(done)
            if done:
                np.testing.assert_array_equal(mine["terminal_observation"], its["terminal_observation"])
                assert mine["TimeLimit.truncated"] == its["TimeLimit.truncated"]
                truncated += mine["TimeLimit.truncated"]
                failed += not mine["TimeLimit.truncated"]
    assert min(failed, truncated) > 0, "both kinds of end must have happened"
    assert all(mine == its for mine, its in sums)
    assert len(set(sums)) > 2


def test_evaluation_sees_the_environment_s_own_returns():
    """Monitored returns and lengths, where a wrapper changes the reward that the algorithm learns from."""
    env = make_vec_env(2, scenario="nominal", **{name: SETTINGS[name] for name in ("control_interval", "horizon")})
    scaled = VecNormalize(env, norm_reward=True, training=False)
    model = PPO("MlpPolicy", scaled, n_steps=8, batch_size=16, device="cpu", seed=0)
    scaled.ret_rms.var = np.array(1e4)
    returns, lengths = evaluate_policy(model, scaled, 2, return_episode_rewards=True)
    assert lengths == [20, 20]
    scalar = CzEnv(scenario="nominal", control_interval=20.0, horizon=400.0)
    observation, total = scalar.reset(seed=0)[0], 0.0
    for _ in range(20):
        observation, reward, *_ = scalar.step(model.predict(scaled.normalize_obs(observation), deterministic=True)[0])
        total += reward
    assert returns == pytest.approx([total, total], rel=1e-4)


@pytest.mark.parametrize("steps", [50, 6])
def test_a_repeated_action_earns_the_sum_of_its_steps_and_ends_with_an_episode(steps):
    """Beside the same steps one by one; episodes of 6 steps end in the middle of the second action."""
    settings = {**SETTINGS, "horizon": 20.0 * steps}
    repeated, plain = make_vec_env(N, action_repeat=4, **settings), make_vec_env(N, **settings)
    for env in (repeated, plain):
        env.seed(5)
        env.reset()
    for action in np.random.default_rng(0).normal(0.0, 0.1, (3, N, 2)).astype(np.float32):
        observation, earned, done, infos = repeated.step(action)
        singly = [plain.step(action) for _ in range(4)]
        over = [bool(each[2].all()) for each in singly]
        counted = singly[: over.index(True) + 1 if any(over) else 4]
        np.testing.assert_array_equal(observation, singly[-1][0])
        np.testing.assert_allclose(earned, np.sum([each[1] for each in counted], axis=0), rtol=1e-6)
        assert done.all() == any(over)
        if done.all():
            np.testing.assert_array_equal(infos[0]["terminal_observation"], counted[-1][3][0]["terminal_observation"])


def test_staggered_first_episodes_end_at_different_times():
    env, ends = adapter(64, stagger=3, scenario="nominal"), []
    env.reset()
    for _ in range(20):
        _, _, done, infos = env.step(np.zeros((64, 2), np.float32))
        ends.append(int(done.sum()))
        assert all(info["TimeLimit.truncated"] for info in infos if info)
    assert max(ends) < 32
    assert sum(ends) >= 64


def test_methods_and_attributes_reach_the_slots_that_are_named_as_in_sb3s_own_vectors():
    """The kind of stable-baselines (hill-a) #675: env_method("reset", indices=[1]) reset every slot."""
    ours, theirs = adapter(), DummyVecEnv([lambda: Monitor(CzEnv(**SETTINGS))] * N)
    action = np.full((N, 2), 0.02, np.float32)

    def both(said):
        one, other = said(ours), said(theirs)
        np.testing.assert_equal(one, other)
        return one

    ours.seed(theirs.seed(5))
    both(lambda env: env.reset())
    both(lambda env: env.step(action)[:3])
    ((seen, info),) = both(lambda env: env.env_method("reset", seed=8, indices=[1]))
    assert (seen.shape, set(info)) == ((73,), {"r_c", "r_ref", "cost", "action_clipped"})
    both(lambda env: env.env_method("reset", options={"scenario": "nominal"}, indices=2))
    assert len(both(lambda env: env.env_method("reset"))) == N
    saved = ours.env_method("get_state", indices=[0])
    for env in (ours, theirs):
        env.env_method("set_state", *saved, indices=range(1, N))
    for _ in range(21):
        ends = [[info.get("episode", {}) for info in env.step(action)[3]] for env in (ours, theirs)]
        for one, other in zip(*ends, strict=True):
            assert (one.get("l"), one.get("r")) == (other.get("l"), pytest.approx(other.get("r"), abs=1e-5))
    both(lambda env: env.set_attr("lesson", 3, indices=[0, 2]))
    assert both(lambda env: env.get_attr("lesson", [0, 2])) == [3, 3]
    assert not both(lambda env: env.has_attr("lesson"))
    assert [config.steps for config in both(lambda env: env.get_attr("config", [2]))] == [20]
    for name in ("action_space", "np_random_seed", "observation_space", "render_mode"):
        both(lambda env, name=name: env.get_attr(name))
    for kind in (Monitor, VecNormalize):
        both(lambda env, kind=kind: env.env_is_wrapped(kind, indices=[1, 2]))
    with pytest.raises(AttributeError, match="no 'step'; its methods are reset, get_state and set_state"):
        ours.env_method("step", action[0], indices=0)


@pytest.mark.parametrize("form", ["vector_entry_point", "sync"])
def test_gymnasiums_wrapper_counts_the_episodes_of_both_forms(form):
    """Wrappers of single-file training loops, as CleanRL's."""
    envs = gym.make_vec("Cz-v0", num_envs=4, vectorization_mode=form, control_interval=20.0, horizon=400.0)
    envs = gym.wrappers.vector.RecordEpisodeStatistics(envs)
    envs.reset(seed=1)
    random, earned, ends = np.random.default_rng(0), np.zeros(4), 0
    for _ in range(96):
        _, reward, terminated, truncated, infos = envs.step(random.uniform(-0.3, 0.3, (4, 2)).astype(np.float32))
        earned += reward
        for i in np.flatnonzero(terminated | truncated):
            assert infos["episode"]["r"][i] == pytest.approx(earned[i], rel=1e-5)
            earned[i], ends = 0.0, ends + 1
    envs.close()
    assert ends >= 16


def remembers_what_the_batch_shows(model, env, agent):
    """A policy and its file keep the means over hours that a batch in a LongMemory shows."""
    shown, state, memory, begins = env.reset(), None, None, np.ones(N, bool)
    channels = model.policy.channels
    for _ in range(30):
        action, _ = model.predict(shown, deterministic=True)
        own, state = model.predict(shown[:, :channels], state, begins, deterministic=True)
        filed, memory = agent.predict(shown[:, :channels], memory, begins)
        np.testing.assert_allclose(own, action, atol=1e-5)
        np.testing.assert_allclose(filed, action, atol=1e-5)
        shown, _, begins, _ = env.step(action)


def test_a_policy_that_is_told_nothing_remembers_hours_too(tmp_path):
    env = LongMemory(adapter())
    kept = {"policy_kwargs": {"interval": 20.0}, "n_steps": 8, "batch_size": 24, "seed": 0, "device": "cpu"}
    model = PPO(RememberingPolicy, env, **kept).learn(48)
    assert save_agent(tmp_path / "agent.onnx", model, "remembering").learned_from == "reward"
    remembers_what_the_batch_shows(model, env, OnnxPolicy.load(tmp_path / "agent.onnx"))
    model.save(tmp_path / "model.zip")
    again, seen = PPO.load(tmp_path / "model.zip", device="cpu"), env.reset()
    np.testing.assert_array_equal(*(each.predict(seen, deterministic=True)[0] for each in (again, model)))
    with pytest.raises(CzError, match=r"reads means over hours: cz_gym.sb3.LongMemory\(make_vec_env"):
        PPO(RememberingPolicy, adapter(), n_steps=8, batch_size=24, device="cpu")


def judge(model, seen, action):
    """What a model's critic says of observations, shape (n, 1)."""
    return model.critic(seen, action)[0] if isinstance(model, SAC) else model.policy.predict_values(seen)


def test_a_critic_may_read_the_true_state_that_no_actor_reads(tmp_path):
    """The state behind the observation is the one of ``observation="state"``, at the end of an episode too."""
    plain, told = adapter(), adapter(critic_state=True)
    states = CzVectorEnv(N, observation="state", autoreset_mode="SameStep", **SETTINGS)
    means = LongMeans.over_hours(BODY, 20.0)
    seen_by_actor = plain.observation_space.shape[0] + len(long_channels(BODY))
    plain.seed(5)
    told.seed(5)
    history, memory = plain.reset(), np.zeros((N, len(means.keep)), np.float32)
    over_hours, memory = means.after(history, memory)
    np.testing.assert_array_equal(told.reset(), np.hstack([history, over_hours, states.reset(seed=5)[0]]))
    actions = np.zeros((N, 2), np.float32)
    for _ in range(20):
        one, other = told.step(actions), plain.step(actions)
        state, *_, info = states.step(actions)
        last = np.stack([each.get("terminal_observation", other[0][i]) for i, each in enumerate(other[3])])
        over_hours, memory = means.after(last, memory)
        begun, _ = means.after(other[0], np.zeros_like(memory))
        shown = np.where(other[2][:, None], begun, over_hours)
        np.testing.assert_array_equal(one[0], np.hstack([other[0], shown, state]))
    assert other[2].all()
    for i in range(N):
        of_the_end = np.hstack([last[i], over_hours[i], info["final_obs"][i]])
        np.testing.assert_allclose(one[3][i]["terminal_observation"], of_the_end, atol=1e-6)
    seen, other_state = one[0], one[0].copy()
    other_state[:, seen_by_actor:] = 7.0
    kept = {"policy_kwargs": {"interval": 20.0}, "batch_size": 24, "seed": 0, "device": "cpu"}
    ppo, sac = (
        PPO(AsymmetricPolicy, told, n_steps=8, **kept),
        SAC(AsymmetricSACPolicy, told, learning_starts=10, **kept),
    )
    for model in (ppo, sac):
        model.learn(24)
        action = model.predict(seen, deterministic=True)[0]
        np.testing.assert_array_equal(action, model.predict(other_state, deterministic=True)[0])
        with torch.no_grad():
            values = [judge(model, torch.tensor(each), torch.tensor(action)) for each in (seen, other_state)]
        assert (values[0] != values[1]).all()
        assert save_agent(tmp_path / "agent.onnx", model, "asymmetric").learned_from == "state"
        remembers_what_the_batch_shows(model, told, OnnxPolicy.load(tmp_path / "agent.onnx"))
    with pytest.raises(ValueError, match="needs observation='history'"):
        adapter(observation="measured", critic_state=True)
    sac.learn(24, LearnState())
    with pytest.raises(CzError, match=r"5 s between actions: policy_kwargs=\{'interval': 20\}"):
        PPO(AsymmetricPolicy, told, n_steps=8, batch_size=24, device="cpu").learn(24, LearnState())
    with pytest.raises(ValueError, match=r"^this needs an Asymmetric, not .*alone$"):
        PPO("MlpPolicy", plain, n_steps=8, batch_size=24, device="cpu").learn(24, LearnState())
    for algorithm, policy in ((PPO, AsymmetricPolicy), (SAC, AsymmetricSACPolicy)):
        with pytest.raises(ValueError, match="told the true state"):
            algorithm(policy, plain)


@pytest.mark.parametrize("process", [BODY, CRYSTAL])
def test_means_over_hours_are_sums_weighted_by_age(process):
    rng, past, interval = np.random.default_rng(0), process.past, 20.0
    history = observations(process)["history"]
    places = [[each.name for each in history].index(signal.name) for signal in past]
    scale = [history[place].scale / signal.scale for place, signal in zip(places, past, strict=True)]
    seen = rng.normal(size=(400, 2, len(history))).astype(np.float32)
    means = LongMeans.over_hours(process, interval)
    memory = np.zeros((2, len(means.keep)), np.float32)
    for row in seen:
        shown, memory = means.after(row, memory)
    chain = [seen[-1][:, places]]
    for time in LONG:
        weights = np.exp(-interval / time * np.arange(len(seen))[::-1])
        chain.append(np.einsum("t,tnc->nc", weights, seen[:, :, places].astype(float)) / weights.sum())
    expected = np.hstack([(later - earlier) * scale for earlier, later in itertools.pairwise(chain)])
    np.testing.assert_allclose(shown, expected, atol=1e-4)
    assert len({each.name for each in long_channels(process)}) == shown.shape[1]


def test_an_estimate_is_fitted_to_the_state_and_not_to_the_reward():
    told = adapter(critic_state=True)
    kept = {"interval": 20.0}
    model = PPO(AsymmetricPolicy, told, 3e-3, n_steps=8, batch_size=24, seed=0, device="cpu", policy_kwargs=kept)
    estimator = model.policy.pi_features_extractor
    before = [each.detach().clone() for each in estimator.parameters()]
    model.learn(48)
    assert all(map(torch.equal, before, estimator.parameters()))
    seen = torch.tensor(model.rollout_buffer.observations).reshape(-1, *told.observation_space.shape)
    start = estimator.loss(seen).item()
    model.learn(1920, LearnState())
    assert estimator.loss(seen).item() < 0.75 * start
    with torch.no_grad():  # an estimator that is right, in the units of its features
        state = seen[:, estimator.gains.numel() :][:, [0, 1, 2, 3, 4, 14, 15, 16, 17]] * estimator.state_gains
        estimator.estimate = lambda _: state
        assert estimator.loss(seen).item() == 0.0
        torch.testing.assert_close(estimator(seen)[:, 13:], state)


def test_the_environment_is_named():
    env = make_vec_env(2, env="CzCrystal-v0", stage="tail", critic_state=True)
    assert env.reset().shape == (2, 95 + 15 + 21)
    assert env.get_attr("config")[0].process.name == "CzCrystal-v0"
    env.close()
    with pytest.raises(CzError, match="unknown environment 'CzCrystal': did you mean 'CzCrystal-v0'"):
        make_vec_env(2, env="CzCrystal")


COPIES = {"copy": copy.copy, "deepcopy": copy.deepcopy, "pickle": lambda each: pickle.loads(pickle.dumps(each))}
"""A shallow copy shares what is inside."""


@pytest.mark.parametrize("way", COPIES)
def test_a_copy_goes_on_as_its_original(way):
    """Python's copies ask an object for attributes before it has any."""
    for original in (
        adapter(), adapter(action_repeat=2), VecNormalize(adapter(), norm_obs=False),
        make_vec_env(2, env="CzCrystal-v0", stage="tail", critic_state=True),
    ):  # fmt: skip
        original.seed(3)
        original.reset()
        other = COPIES[way](original)
        if isinstance(original, VecNormalize):
            other = VecNormalize(COPIES[way](original.venv), norm_obs=False)
        if way != "copy":
            action = np.full((original.num_envs, 2), 0.1, np.float32)
            np.testing.assert_array_equal(original.step(action)[0], other.step(action)[0])
        else:
            assert other.num_envs == original.num_envs


def test_options_may_be_given_one_a_slot():
    ours, theirs = adapter(), DummyVecEnv([lambda: CzEnv(**SETTINGS)] * N)
    theirs.reset()
    (state,) = theirs.env_method("get_state", indices=[1])
    every = {"scenario": "nominal"}
    for options in (every, {"state": state}, [every, {}, {"state": state}], [{"scenario": {"hard": 1.0}}, {}, {}]):
        for _ in range(2):
            ours.seed(theirs.seed(5))
            for env in (ours, theirs):
                env.set_options(options)
            np.testing.assert_array_equal(ours.reset(), theirs.reset())
        np.testing.assert_array_equal(ours.reset(), theirs.reset())
    with pytest.raises(CzError, match="expected options for 3 slots, got 2"):
        ours.env.reset(options=[{}, {}])
    with pytest.raises(CzError, match="unknown reset option 'seed'"):
        ours.env.reset(options=[{}, {}, {"seed": 3}])


def test_one_seed_of_the_batch_is_no_slot_s_own():
    env = adapter()
    assert env.seed(7) == [7] * N
    first = env.reset()
    np.testing.assert_array_equal(first, env.env.reset(seed=7)[0])
    assert not np.array_equal(env.reset(), first)
    env.seed()
    assert not np.array_equal(env.reset(), first)


def test_steps_of_an_environment_that_repeats_actions_are_counted():
    model = PPO("MlpPolicy", DummyVecEnv([lambda: CzEnv(**SETTINGS, action_repeat=4)]), n_steps=8, batch_size=8,
                device="cpu")  # fmt: skip
    assert environment_steps(model.learn(8)) == 32
