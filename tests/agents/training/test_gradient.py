"""Learning from the gradient: it is the cost's own, the exported memory is the trained one, and it learns."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("sb3_contrib")

from contracts import facts
from stable_baselines3.common.logger import Logger

from cz_gym.agents import OnnxPolicy
from cz_gym.agents.agent_file.contract import facts_of, make_contract
from cz_gym.agents.training import filter_bank
from cz_gym.agents.training.filter_bank import STATE, FilterBank
from cz_gym.agents.training.gradient import GradientLearner, PlantStep
from cz_gym.agents.training.learners import config_of
from cz_gym.agents.training.recipes import RECIPES, Gradient
from cz_gym.agents.training.validation import Validation, validate
from cz_gym.differentiable import DifferentiableBatch
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.observation import MEASURED

FEW = Gradient(num_envs=16, window=20, steps=16 * 20 * 2, hidden=(8,))
CONFIG = config_of(FEW)


def some_network(seed: int = 0) -> FilterBank:
    torch.manual_seed(seed)
    network = FilterBank(5.0, (8,))
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.copy_(0.05 * torch.randn_like(parameter))
        network.mean.copy_(0.01 * torch.randn_like(network.mean))
        network.per_std.copy_(1.0 + torch.rand_like(network.per_std))
    return network


def driven(network: FilterBank, batch: DifferentiableBatch, steps: int) -> Any:
    """Mean cost of some crystals that the network drives."""
    state, measured = (torch.from_numpy(each) for each in batch.reset(range(batch.num_envs)))
    memory, costs, step = torch.zeros(batch.num_envs, STATE), [], PlantStep.apply
    for _ in range(steps):
        action, memory = network(measured, memory)
        state, measured, terms = step(state, action, batch)
        costs.append(terms.sum(dim=1))
    return torch.stack(costs).mean()


@pytest.mark.parametrize(("scenario", "apart"), [("randomized", 0.01), ("puller", 0.05)])
def test_the_gradient_is_that_of_differences(scenario: str, apart: float) -> None:
    """Along a random direction of all weights, through 40 steps of plant, sensors, memory and policy.

    The heater of ``puller`` moves in whole steps, which differences see and the gradient does not.
    """
    network, batch = some_network(), DifferentiableBatch(CONFIG.with_scenario(scenario), 12)
    driven(network, batch, 40).backward()
    directions = [torch.randn_like(parameter) for parameter in network.parameters()]
    along = sum(
        float((parameter.grad * direction).sum())
        for parameter, direction in zip(network.parameters(), directions, strict=True)
        if parameter.grad is not None
    )
    costs = []
    for by in (2e-3, -2e-3):
        with torch.no_grad():
            for parameter, direction in zip(network.parameters(), directions, strict=True):
                parameter += by * direction
            costs.append(float(driven(network, batch, 40)))
            for parameter, direction in zip(network.parameters(), directions, strict=True):
                parameter -= by * direction
    assert along == pytest.approx((costs[0] - costs[1]) / 4e-3, rel=apart)


def test_the_exported_memory_is_the_trained_one() -> None:
    network = some_network()
    content = network.onnx()
    about = facts_of(CONFIG) | {name: facts()[name] for name in ("algorithm", "training_seed", "training_steps")}
    contract = make_contract(content, **about, validation_cost=0.0, validation_rmse_mm=0.0)
    policy = OnnxPolicy.of(contract, content, CONFIG)
    random = np.random.default_rng(0)
    memory, state = torch.zeros(3, STATE), None
    for _ in range(30):
        seen = random.normal(0.0, 0.3, (3, len(MEASURED))).astype(np.float32)
        with torch.no_grad():
            wanted, memory = network(torch.from_numpy(seen), memory)
        action, state = policy.predict(seen, state)
        np.testing.assert_allclose(action, wanted.clamp(-1.0, 1.0).numpy(), atol=1e-5)
        np.testing.assert_allclose(state, memory.numpy(), atol=1e-5)
    assert policy.remembers == STATE


def test_what_is_remembered() -> None:
    """After a step of the ring error: its means rise as first-order lags, its integral grows, the spread jumps."""
    network, memory = FilterBank(5.0, ()), torch.zeros(1, STATE)
    seen = torch.zeros(1, len(MEASURED))
    seen[0, 0] = 1.0
    with torch.no_grad():
        for _ in range(100):
            features, memory = network.remember(seen, memory)
    times = np.array(filter_bank.TIMES)
    np.testing.assert_allclose(memory[0, : len(times)], 1.0 - np.exp(-500.0 / times), rtol=1e-4)
    assert float(memory[0, -3]) == pytest.approx(0.5, rel=1e-4)
    assert 0.0 < float(memory[0, -2]) < 0.2
    assert float(memory[0, -1]) == 0.0
    np.testing.assert_allclose(features[0, :8].sum(), 1.0, rtol=1e-5)


def test_it_learns_from_nothing() -> None:
    """Forty updates on a third of the recipe's crystals: from losing all crystals to holding most of them."""
    recipe: Any = replace(RECIPES["gradient"], num_envs=64, steps=64 * 180 * 40, hidden=())
    learner, config = GradientLearner(recipe, 0, config_of(recipe), Logger(None, []), 0), config_of(recipe)

    def judged() -> Validation:
        content = learner.exported()
        contract = make_contract(content, **{**facts(), **facts_of(config), "channels": len(MEASURED)})
        return validate(OnnxPolicy.of(contract, content, config), config, VALIDATION_SEEDS[:16])

    assert judged().failure_rate > 0.8
    learner.learn(lambda steps, doing: None)
    assert learner.steps == learner.total == 64 * 180 * 40
    assert judged().failure_rate < 0.3
