"""Imitating a teacher: what it demonstrates, what the network makes of it, and which crystals are shown."""

from dataclasses import astuple, replace
from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3.common.logger import Logger

from cz_gym import CzVectorEnv
from cz_gym.agents.training import demonstrations, imitation
from cz_gym.agents.training.demonstrations import Demonstrations, demonstrate, widened
from cz_gym.agents.training.networks import whitening
from cz_gym.agents.training.recipes import RECIPES, Imitation
from cz_gym.baselines.registry import find_controller, make_controller
from cz_gym.config import make_config
from cz_gym.episodes.scenarios import find_scenario
from cz_gym.observation import DRIVE_CHANNELS, HISTORY

CONFIG = make_config("randomized", observation="history", horizon=600.0, action="smooth")
FEW = Imitation(name="few", teacher="lqg", hidden=(16, 16), rounds=2, episodes=8, wide_share=0.25, epochs=1)
APPLIED = list(DRIVE_CHANNELS)


class Teacher:
    """Moves the drives by a function of the observation."""

    def __init__(self, moves: Any) -> None:
        self.moves = moves

    def predict(self, observation: Any, state: Any = None, episode_start: Any = None) -> Any:
        return (observation[:, APPLIED] + self.moves(observation)).astype(np.float32), state


def linear(observation: np.ndarray) -> np.ndarray:
    return np.column_stack([-0.01 * observation[:, 0] + 0.002 * observation[:, 11], 0.003 * observation[:, 8]])


def bent(observation: np.ndarray) -> np.ndarray:
    return 0.02 * np.abs(observation[:, [0, 0]])


def imitator(recipe: Imitation = FEW, teacher: Any = None, config: Any = CONFIG, seed: int = 0) -> imitation.Imitator:
    return imitation.Imitator(recipe, seed, teacher or Teacher(linear), config, Logger(None, []), 0)


def shown(moves: Any, recipe: Imitation = FEW) -> tuple[Any, Demonstrations]:
    """A network whose linear path is fitted to a teacher, and the demonstrations."""
    torch.set_num_threads(1)
    network = imitation.make_network(recipe, 0)
    found = demonstrate(Teacher(moves), CONFIG, range(8), (0.05, 0.05))
    imitation.fit_linear_path(network, found)
    return network, found


def error(network: Any, found: Demonstrations) -> np.ndarray:
    """Mean error of either drive."""
    return np.abs(imitation.mean_action(network)(found.observation) - found.action).mean(axis=0)


def test_whitened_observations_are_uncorrelated() -> None:
    random = np.random.default_rng(0)
    seen = random.normal(size=(5000, 6)) @ random.normal(size=(6, 6)) + 3.0
    np.testing.assert_allclose(np.cov((seen @ whitening(np.cov(seen.T))).T), np.eye(6), atol=1e-6)


@pytest.mark.parametrize("hidden", [(16, 16), ()])
def test_a_linear_teacher_is_imitated_exactly(hidden: tuple[int, ...]) -> None:
    network, found = shown(linear, replace(FEW, hidden=hidden))
    assert np.abs(found.action).max() < 1.0
    np.testing.assert_allclose(imitation.mean_action(network)(found.observation), found.action, atol=1e-4)


@pytest.mark.parametrize(("weights", "heater_learns"), [((1.0, 0.0), False), ((1.0, 1.0), True)])
def test_the_layers_learn_what_bends_the_teacher(weights: tuple[float, float], heater_learns: bool) -> None:
    recipe = replace(FEW, epochs=1500, learning_rate=5e-3, loss_weights=weights)
    network, found = shown(bent, recipe)
    before = error(network, found)
    imitation.fit(network, found, recipe)
    after = error(network, found)
    assert after[0] < 0.5 * before[0]
    assert (after[1] < 0.8 * before[1]) if heater_learns else (after[1] == pytest.approx(before[1], abs=1e-9))


def test_a_teacher_is_told_of_the_crystals_and_the_imitation_is_not() -> None:
    """The privileged teacher answers otherwise than the plain one to the same observations; no observation tells."""
    rough = find_scenario("randomized")
    rough = replace(rough, interface=replace(rough.interface, sd=(1.0, 1.0)))
    config, seeds, none = replace(CONFIG, scenario=rough, action="direct"), range(40, 43), (0.0, 0.0)
    told, plain = (make_controller(name, make_config("randomized")) for name in ("lqg-quiet-privileged", "lqg-quiet"))
    one, other = (demonstrate(each, config, seeds, none, lambda seen: seen[:, APPLIED]) for each in (told, plain))
    np.testing.assert_array_equal(one.observation, other.observation)
    expected: Any = told
    env = CzVectorEnv(len(seeds), scenario=rough, observation="history", horizon=config.horizon)
    observation, _ = env.reset(seed=list(seeds))
    action, _ = expected.for_episodes(config, seeds).predict(observation, None, np.ones(len(seeds), np.bool_))
    np.testing.assert_array_equal(one.action[: len(seeds)], action)
    assert np.abs(one.action - other.action).max() > 1e-3


def test_lost_crystals_teach_nothing() -> None:
    reckless = Teacher(lambda seen: np.full((len(seen), 2), [2.0, 0.0]))
    found = demonstrate(reckless, replace(CONFIG, horizon=3600.0), range(4), (0.0, 0.0))
    assert len(found.action) < 4 * 720 / demonstrations.SAMPLE_EVERY
    assert np.abs(found.observation[:, 0]).max() < 10.0


def test_the_imitation_of_lqg_holds_the_radius() -> None:
    config = make_config("randomized", observation="history", action="smooth")
    recipe = Imitation(name="lqg", teacher="lqg", rounds=1, episodes=48, wide_share=0.0)
    learner = imitator(recipe, make_controller("lqg", make_config("randomized")), config)
    told: list[tuple[int, str]] = []
    learner.learn(lambda steps, doing: told.append((steps, doing)))
    assert learner.steps == learner.total == told[-1][0] == 48 * config.steps
    env = CzVectorEnv.from_config(config, 16)
    observation, info = env.reset(seed=list(range(950_000, 950_016)))
    squares = []
    act = imitation.mean_action(learner.network)
    for _ in range(1000):
        observation, _, terminated, _, info = env.step(act(observation))
        assert not terminated.any()
        squares.append((info["r_c"] - info["r_ref"]) ** 2)
    assert np.sqrt(np.mean(squares[360:])) < 0.15e-3


def test_past_samples_that_are_not_seen_change_nothing() -> None:
    network, found = shown(linear, replace(FEW, memory=30.0))
    old = np.array([channel.name.rpartition("_")[2] in ("45s", "60s", "1200s") for channel in HISTORY])
    assert old.sum() == 12
    other = np.where(old, found.observation + 1.0, found.observation).astype(np.float32)
    act = imitation.mean_action(network)
    np.testing.assert_array_equal(act(other), act(found.observation))


def test_wide_crystals_spread_as_hard_does() -> None:
    trained_on, hard = find_scenario("randomized"), find_scenario("hard")
    assert widened(trained_on, 1.0) is trained_on
    ours = widened(trained_on, 1.5)
    assert ours.reference.amount == hard.reference.amount
    assert (ours.recipe, ours.drift, ours.interface) == (hard.recipe, hard.drift, hard.interface)
    np.testing.assert_allclose(astuple(ours.pullers)[1:], astuple(hard.pullers)[1:], rtol=1e-12)
    assert ours.pullers.mix == hard.pullers.mix


@pytest.mark.parametrize(("share", "expected"), [(0.25, [(True, 2), (False, 6)] * 2), (1.0, [(True, 8)] * 2)])
def test_each_round_shows_as_many_wide_crystals_as_asked(
    share: float, expected: list[tuple[bool, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    met = []

    def noted(teacher: Any, config: Any, seeds: Any, noise: Any, driver: Any, progress: Any) -> Demonstrations:
        met.append((config.scenario.name.endswith("-times-2"), list(seeds), driver is not None))
        return demonstrate(teacher, config, seeds, noise, driver, progress)

    monkeypatch.setattr(imitation, "demonstrate", noted)
    imitator(replace(FEW, wide_share=share), seed=4).learn(lambda steps, doing: None)
    assert [(wide, len(seeds)) for wide, seeds, _ in met] == expected
    every = [seed for _, seeds, _ in met for seed in seeds]
    assert every == list(range(every[0], every[0] + 16))
    assert [driven for *_, driven in met] == [k >= len(met) // 2 for k in range(len(met))]
    other = imitator(seed=5)._round
    met.clear()
    other(0, lambda steps, doing: None)
    assert not {seed for _, seeds, _ in met for seed in seeds} & set(every)


def test_an_interrupted_imitation_begins_again_and_ends_as_one_that_was_not() -> None:
    def interrupt(steps: int, doing: str) -> None:
        if doing.startswith("round 2"):
            raise KeyboardInterrupt

    whole, stopped = imitator(), imitator()
    whole.learn(lambda steps, doing: None)
    with pytest.raises(KeyboardInterrupt):
        stopped.learn(interrupt)
    assert stopped.steps == 0
    stopped.learn(lambda steps, doing: None)
    assert stopped.exported() == whole.exported()


def test_it_is_judged_by_the_cost_that_its_teacher_s_regulator_was_made_for() -> None:
    recipe = RECIPES["imitation"]
    assert isinstance(recipe, Imitation)
    teacher: Any = find_controller(recipe.teacher).make(make_config("randomized"))
    np.testing.assert_allclose(recipe.weights, teacher.design.weights, rtol=0.01)
