"""Crystals of several scenarios side by side: each is as alone, and each may count by the root of its cost."""

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from cz_gym.agents.training.crystals import CostNormaliser, Crystals
from cz_gym.agents.training.recipes import Gradient
from cz_gym.differentiable import DifferentiableBatch

CONFIG = Gradient().config


def test_crystals_of_several_scenarios_are_those_of_each_alone() -> None:
    other = CONFIG.with_scenario("puller")
    both, alone = Crystals([(CONFIG, 3), (other, 2)]), [DifferentiableBatch(each, 2) for each in (CONFIG, other)]
    both.reset(range(5))
    seen = both.reset([7, 8, 7, 8], [1, 2, 3, 4])
    actions = np.random.default_rng(0).normal(0.0, 0.3, (5, 2))
    actions[3:] = actions[1:3]
    for place, batch in zip((slice(1, 3), slice(3, 5)), alone, strict=True):
        np.testing.assert_array_equal(seen[place], batch.reset([7, 8])[1])
    step = both.step(actions)
    for place, batch in zip((slice(1, 3), slice(3, 5)), alone, strict=True):
        for ours, theirs in zip(step, batch.step(actions[place]), strict=True):
            np.testing.assert_array_equal(ours[place], theirs)
    assert both.grows.shape == (5,)


def test_crystals_count_by_the_root_of_their_cost() -> None:
    """Of three scenarios' crystals with 1, 100 and 0 times a cost that falls with their age, two rough ones have four
    times the cost of the calm: their gradients come to count half as much. A new crystal counts as any other."""
    normaliser = CostNormaliser(Crystals([(CONFIG, 4), (CONFIG, 4), (CONFIG, 1)]), 12)
    size, roughness = np.array([1.0] * 4 + [100.0] * 4 + [0.0]), np.array([1.0, 1.0, 4.0, 4.0] * 2 + [1.0])
    for _ in range(10):
        for age in range(12):
            weights = normaliser.weights(size * roughness / (1.0 + age))
        normaliser.begin([0, *range(1, 9)])
    np.testing.assert_allclose(weights[[2, 3, 6, 7]] / weights[[0, 1, 4, 5]], 0.5, rtol=0.1)
    assert np.isfinite(weights).all()
    np.testing.assert_allclose(normaliser._relative, 1.0)
