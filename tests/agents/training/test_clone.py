"""Imitating a teacher, comparing with it on the same crystal, and learning gently from there."""

from __future__ import annotations

from dataclasses import astuple, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode

from cz_gym import CzVectorEnv
from cz_gym.agents.policies.residual import Residual
from cz_gym.agents.training import export
from cz_gym.agents.training import imitation as clone
from cz_gym.agents.training import recipes as settings
from cz_gym.agents.training.learners import clone as clone_into
from cz_gym.agents.training.learners import make_training, training_scenario, widened
from cz_gym.agents.training.networks import Paced
from cz_gym.agents.training.pairing import PairedReward
from cz_gym.agents.training.vec_env import CzVecEnv
from cz_gym.agents.training.wrappers import TrainingReward
from cz_gym.baselines.lqg.settings import lqg
from cz_gym.baselines.registry import find_controller
from cz_gym.config import make_config
from cz_gym.episodes.scenarios import find_scenario
from cz_gym.observation import HISTORY
from cz_gym.task import HEATER_STEP_WEIGHT, PULL_STEP_WEIGHT, PULL_WEIGHT, Cost, reward

CONFIG = make_config("randomized", observation="history", horizon=600.0)
TINY = replace(
    settings.PPO(),
    recipe=settings.Recipe(num_envs=4, hidden=(16, 16), clone=settings.Clone("lqg")),
    steps=256,
    n_steps=32,
    batch_size=64,
    n_epochs=1,
    critic_steps=0,
)


class Teacher:
    """Moves the drives by a function of the observation."""

    def __init__(self, moves: Any) -> None:
        self.moves = moves

    def predict(self, observation: Any, state: Any = None, episode_start: Any = None) -> Any:
        return (observation[:, [9, 10]] + self.moves(observation)).astype(np.float32), state


def policy_of(teacher: Any = None, choice: settings.PPO = TINY) -> Any:
    return make_training(replace(choice, paired=teacher is not None), 0, None, 0, teacher).learner.policy


def linear(observation: np.ndarray) -> np.ndarray:
    return np.column_stack([-0.01 * observation[:, 0] + 0.002 * observation[:, 11], 0.003 * observation[:, 8]])


def test_whitened_observations_are_uncorrelated() -> None:
    random = np.random.default_rng(0)
    seen = random.normal(size=(5000, 6)) @ random.normal(size=(6, 6)) + 3.0
    mean, scaling = clone.whitening(seen.astype(np.float32))
    np.testing.assert_allclose(np.cov(((seen - mean) @ scaling).T), np.eye(6), atol=1e-3)


def test_a_linear_teacher_is_imitated_exactly() -> None:
    policy = policy_of()
    shown = clone.demonstrate(Teacher(linear), CONFIG, range(8), (0.01, 0.01))
    clone.begin_linear(policy, shown)
    acts = clone.acts(policy)(shown.observation)
    np.testing.assert_allclose(acts, shown.action, atol=2e-5)


def test_the_layers_learn_what_bends_the_teacher() -> None:
    bent = Teacher(lambda seen: np.column_stack([0.02 * np.abs(seen[:, 0]), np.zeros(len(seen))]))
    policy = policy_of()
    shown = clone.demonstrate(bent, CONFIG, range(8), (0.01, 0.001))
    clone.begin_linear(policy, shown)
    before = np.abs(clone.acts(policy)(shown.observation) - shown.action)[:, 0].mean()
    clone.fit(policy, shown, settings.Clone("lqg", epochs=60, learning_rate=5e-3))
    assert np.abs(clone.acts(policy)(shown.observation) - shown.action)[:, 0].mean() < 0.5 * before


def test_a_teacher_is_told_of_the_crystals_that_are_shown_and_the_imitation_is_not() -> None:
    """The told teacher answers otherwise than the one it bounds to the same observations; no observation tells."""
    rough = find_scenario("randomized")
    rough = replace(rough, interface=replace(rough.interface, sd=(1.0, 1.0)))
    config, seeds, none = CONFIG.with_scenario(rough), range(40, 48), (0.0, 0.0)
    told, plain = (find_controller(name).make(make_config("randomized")) for name in ("lqg-quiet-told", "lqg-quiet"))
    still = lambda seen: seen[:, [9, 10]]  # noqa: E731
    one, other = (clone.demonstrate(teacher, config, seeds, none, still) for teacher in (told, plain))
    np.testing.assert_array_equal(one.observation, other.observation)
    expected, memory = told.for_episodes(config, seeds), None
    env = CzVectorEnv(len(seeds), scenario=rough, observation="history", horizon=config.horizon)
    observation, _ = env.reset(seed=list(seeds))
    answer, memory = expected.predict(observation, memory, np.ones(len(seeds), np.bool_))
    np.testing.assert_array_equal(one.action[: len(seeds)], answer)
    assert np.abs(one.action - other.action).max() > 1e-3


def test_lost_crystals_teach_nothing() -> None:
    shown = clone.demonstrate(
        Teacher(lambda seen: np.full((len(seen), 2), [2.0, 0.0])), replace(CONFIG, horizon=3600.0), range(4), (0.0, 0.0)
    )
    assert len(shown.action) < 4 * 720 / clone.EVERY
    assert np.abs(shown.state[:, 0]).max() < 8.0


def test_the_imitation_of_lqg_holds_the_radius() -> None:
    policy = policy_of(choice=replace(TINY, recipe=settings.Recipe(num_envs=4, clone=settings.Clone("lqg"))))
    config = make_config("randomized", observation="history")
    few = settings.Clone("lqg", rounds=1, episodes=48, epochs=4)
    clone.imitate(policy, lqg(make_config("randomized")), config, config, few, 900_000)
    env = CzVectorEnv(16, scenario="randomized", observation="history")
    observation, info = env.reset(seed=list(range(950_000, 950_016)))
    squares = []
    for _ in range(1000):
        observation, _, terminated, _, info = env.step(np.clip(clone.acts(policy)(observation), -1.0, 1.0))
        assert not terminated.any()
        squares.append((info["r_c"] - info["r_ref"]) ** 2)
    assert np.sqrt(np.mean(squares[360:])) < 0.15e-3


def slots(n: int = 3, horizon: float = 100.0) -> CzVecEnv:
    env = CzVectorEnv(
        n, scenario="randomized", observation="history", horizon=horizon, autoreset_mode=AutoresetMode.SAME_STEP
    )
    made = CzVecEnv(env, privileged=True, stagger=7)
    made.seed(40)
    return made


def test_an_agent_that_does_what_its_teacher_does_earns_nothing_more() -> None:
    base = slots()
    env = PairedReward(TrainingReward(base, 0.9), base, lqg(make_config("randomized")))
    twin = lqg(make_config("randomized"))
    observation, memory, begins = env.reset(), None, np.ones(3, np.bool_)
    for _ in range(70):
        action, memory = twin.predict(observation[:, : len(HISTORY)], memory, begins)
        observation, gained, begins, _ = env.step(action)
        np.testing.assert_allclose(gained[~begins], 0.0, atol=1e-7)
    assert env.together.all()
    env.close()


def test_a_teacher_that_loses_its_crystal_is_no_longer_compared_with() -> None:
    base = slots(horizon=3600.0)
    env = PairedReward(TrainingReward(base, 0.9), base, Teacher(lambda seen: np.full((len(seen), 2), [2.0, 0.0])))
    keeper, observation, memory, begins = lqg(make_config("randomized")), env.reset(), None, np.ones(3, np.bool_)
    for _ in range(500):
        action, memory = keeper.predict(observation[:, : len(HISTORY)], memory, begins)
        observation, gained, begins, _ = env.step(action)
        assert np.isfinite(gained).all()
    assert not env.together.any()
    assert np.abs(gained).max() < 0.2
    env.close()


def test_the_critic_learns_first() -> None:
    training = make_training(replace(TINY, critic_steps=512, steps=1024), 0, None, 0, lqg(make_config("randomized")))
    policy = training.learner.policy
    actor, critic = policy.mlp_extractor.direct.weight, policy.value_net.weight
    before = actor.detach().clone(), critic.detach().clone()
    training.learner.learn(256, callback=training.callbacks)
    assert torch.equal(actor, before[0])
    assert not torch.equal(critic, before[1])


def test_the_weighed_reward_is_the_weighed_cost_s() -> None:
    base = slots()
    weights = settings.CostWeights(pull=0.5, pull_step=3.0, heater_step=2.0)
    env = TrainingReward(base, 0.9, weights)
    env.reset()
    _, gained, done, _ = env.step(np.full((3, 2), 0.1, np.float32))
    said = base.info
    cost = Cost(
        said["cost_radius"], 0.5 * said["cost_pull"], 3.0 * said["cost_pull_step"], 2.0 * said["cost_heater_step"]
    )
    assert not done.any()
    np.testing.assert_allclose(gained, 0.1 * reward(cost), rtol=1e-6)


def test_a_group_of_parameters_keeps_its_pace() -> None:
    still, slow, fast = (torch.nn.Parameter(torch.zeros(3)) for _ in range(3))
    groups = [{"params": part, "pace": pace} for part, pace in ((still, 0.0), (slow, 0.1), (fast, 1.0))]
    optimiser = Paced(groups, 1e-2)
    for part in (still, slow, fast):
        part.grad = torch.ones(3)
    optimiser.step()
    assert torch.equal(still, torch.zeros(3))
    torch.testing.assert_close(10.0 * slow.detach(), fast.detach())
    assert [group["lr"] for group in optimiser.param_groups] == [1e-2] * 3


@pytest.mark.parametrize("frozen", [("heater", "layers"), ()])
def test_what_is_frozen_stays(frozen: tuple[str, ...]) -> None:
    training = make_training(replace(TINY, frozen=frozen), 0, None, 0, lqg(make_config("randomized")))
    policy = training.learner.policy
    direct, layer = policy.mlp_extractor.direct, policy.mlp_extractor.actor[0]
    before = direct.weight.detach().clone(), layer.weight.detach().clone()
    training.learner.learn(256, callback=training.callbacks)
    assert not torch.equal(direct.weight[0], before[0][0])
    assert torch.equal(direct.weight[1], before[0][1]) == ("heater" in frozen)
    assert torch.equal(layer.weight, before[1]) == ("layers" in frozen)
    # What no optimiser clears would pile up, and count where gradients are clipped.
    assert (layer.weight.grad is None) == ("layers" in frozen)


def test_what_is_not_seen_changes_nothing() -> None:
    choice = replace(TINY, recipe=replace(TINY.recipe, memory=30.0))
    training = make_training(replace(choice, paired=False), 0, None)
    shown = clone.demonstrate(Teacher(linear), CONFIG, range(4), (0.01, 0.01))
    clone.begin_linear(training.learner.policy, shown)
    exported = export.actor_of(training.learner)
    old = np.array([channel.name.rpartition("_")[2] in ("45s", "60s", "1200s") for channel in HISTORY])
    assert old.sum() == 12
    other = np.where(old, shown.observation + 1.0, shown.observation).astype(np.float32)
    np.testing.assert_array_equal(
        clone.acts(training.learner.policy)(other), clone.acts(training.learner.policy)(shown.observation)
    )
    assert not exported.scaling[old].any()


def test_pullers_spread_as_wide_as_asked() -> None:
    asked = [training_scenario(replace(TINY.recipe, width=width)).pullers for width in (0.0, 0.5, 1.0, 1.5)]
    assert [each.mix for each in asked] == [(0.5, 0.5), (0.25, 0.75), (0.0, 1.0), (0.0, 1.0)]
    np.testing.assert_allclose([each.capillary for each in asked], [0.0, 0.015, 0.03, 0.045])
    np.testing.assert_allclose([each.conductance for each in asked], [0.0, 0.05, 0.1, 0.15])
    assert {each.start_radius_sd for each in asked} == {0.2e-3}


def test_what_an_imitation_is_shown_spreads_as_hard_does() -> None:
    trained_on, hard = find_scenario("randomized"), find_scenario("hard")
    assert widened(trained_on, 1.0) is trained_on
    ours = widened(trained_on, 1.5)
    assert ours.reference.amount == hard.reference.amount
    assert (ours.recipe, ours.drift, ours.interface) == (hard.recipe, hard.drift, hard.interface)
    np.testing.assert_allclose(astuple(ours.pullers)[1:], astuple(hard.pullers)[1:], rtol=1e-12)
    assert ours.pullers.mix == hard.pullers.mix


def test_a_network_beside_a_controller_begins_as_the_controller() -> None:
    recipe = replace(TINY.recipe, clone=settings.Clone("lqg", rounds=1, episodes=2), residual=True)
    choice = replace(TINY, recipe=replace(recipe, head=settings.ActionHead(skip=0.0)), noise=(1e-9, 1e-9))
    teacher = lqg(make_config("randomized"))
    training = make_training(choice, 0, None, 0, teacher)
    clone_into(training, teacher, CONFIG, 0, lambda _: None)
    training.learner.learn(128)
    np.testing.assert_allclose(training.learner.rollout_buffer.rewards, 0.0, atol=1e-6)
    both = Residual(teacher, Teacher(lambda seen: np.full((len(seen), 2), 0.01) - seen[:, [9, 10]]))
    seen = np.zeros((3, len(HISTORY)), np.float32)
    action, memory = both.predict(seen, None, np.ones(3, np.bool_))
    alone, expected = teacher.predict(seen, None, np.ones(3, np.bool_))
    np.testing.assert_allclose(action, alone + 0.01, atol=1e-7)
    np.testing.assert_equal(memory, expected)


@pytest.mark.parametrize(("share", "shown"), [(0.25, [("wide", 2), ("own", 6)] * 2), (1.0, [("wide", 8)] * 2)])
def test_each_round_shows_as_many_wide_crystals_as_asked(
    share: float, shown: list[tuple[str, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, met = clone.demonstrate, []

    def counted(teacher: Any, config: Any, seeds: Any, *rest: Any) -> clone.Shown:
        met.append((config.scenario.name, list(seeds)))
        return asked(teacher, config, seeds, *rest)

    monkeypatch.setattr(clone, "demonstrate", counted)
    of = {name: CONFIG.with_scenario(replace(CONFIG.scenario, name=name)) for name in ("own", "wide")}
    choice = settings.Clone("lqg", rounds=2, episodes=8, wide_share=share, epochs=1)
    clone.imitate(policy_of(), Teacher(linear), of["own"], of["wide"], choice, 700)
    assert [(name, len(seeds)) for name, seeds in met] == shown
    assert [seed for _, seeds in met for seed in seeds] == list(range(700, 716))


def test_a_kept_imitation_is_the_imitation(tmp_path: Path) -> None:
    asked = []

    def made(privileged: bool) -> Any:
        few = replace(
            TINY.recipe, clone=settings.Clone("lqg", rounds=1, episodes=2, epochs=1), privileged_critic=privileged
        )
        training = make_training(replace(TINY, recipe=few, paired=False), 0, None)
        clone_into(training, Counted(linear), CONFIG, 3, lambda _: None, tmp_path)
        return training.learner.policy

    class Counted(Teacher):
        def predict(self, *args: Any, **kwargs: Any) -> Any:
            asked.append(1)
            return super().predict(*args, **kwargs)

    first = made(True)
    times = len(asked)
    assert times == CONFIG.steps
    second, other = made(True), made(False)
    assert len(asked) == times
    seen = np.random.default_rng(0).normal(size=(5, len(HISTORY))).astype(np.float32)
    for policy in (second, other):
        np.testing.assert_array_equal(clone.acts(policy)(seen), clone.acts(first)(seen))
    assert torch.equal(first.features_extractor.scaling, second.features_extractor.scaling)
    (kept,) = tmp_path.iterdir()
    kept.write_bytes(kept.read_bytes()[:1000])
    np.testing.assert_array_equal(clone.acts(made(True))(seen), clone.acts(first)(seen))
    assert len(asked) == 2 * times


@pytest.mark.parametrize("name", ["ppo", "ppo-medium", "ppo-quiet"])
def test_a_recipe_learns_for_the_cost_that_its_teacher_s_regulator_was_made_for(name: str) -> None:
    recipe = settings.RECIPES[name].recipe
    assert recipe.clone is not None
    teacher: Any = find_controller(recipe.clone.teacher).make(make_config("randomized"))
    theirs, ours = teacher.settings.weights, recipe.weights
    assert ours.pull * PULL_WEIGHT == pytest.approx(theirs.pull, rel=0.01)
    assert ours.pull_step * PULL_STEP_WEIGHT == pytest.approx(theirs.pull_step, rel=0.01)
    assert ours.heater_step * HEATER_STEP_WEIGHT == pytest.approx(theirs.heater_step, rel=0.01)
