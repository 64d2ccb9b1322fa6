"""Learning from the gradient: it is the cost's own, the exported memory is the trained one, and it learns."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("stable_baselines3")

from stable_baselines3.common.logger import Logger

from cz_gym import agents
from cz_gym.agents import AgentFileError, OnnxPolicy
from cz_gym.agents.agent_file.contract import facts_of, make_contract
from cz_gym.agents.training import filter_bank, gradient
from cz_gym.agents.training.crystals import Crystals
from cz_gym.agents.training.filter_bank import STATE, FilterBank
from cz_gym.agents.training.gradient import GradientLearner
from cz_gym.agents.apg.plant_step import PlantStep
from cz_gym.agents.training.recipes import LQG_COST, RECIPES, Gradient
from cz_gym.agents.training.validation import Validation, validate
from cz_gym.cost import COST_CAP, SCALES, Cost
from cz_gym.differentiable import STATES, DifferentiableBatch
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.observation import MEASURED
from tests.contracts import facts

FEW = Gradient(num_envs=16, window=20, steps=16 * 20 * 2, hidden=(8,))
CONFIG = FEW.config
VALID = [channel.name for channel in MEASURED].index("valid")


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

    The heater of ``puller`` moves in whole steps, which differences see and the gradient does not. The estimates of
    noise and swings, which are taken as they are, count as nothing here.
    """
    network, batch = some_network(), DifferentiableBatch(CONFIG.with_scenario(scenario), 12)
    network.per_std[-6:] = 0.0
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


@pytest.mark.parametrize("scenario", ["randomized", "sensor-fault"])
def test_what_is_followed_is_the_gradient_that_torch_finds(scenario: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Back through plant and memory by hand, or through a graph of every step: the same, lost crystals among them."""
    monkeypatch.setattr(gradient, "MOST_GRADIENT", 1e9)
    learner = GradientLearner(replace(FEW, window=60, weights=LQG_COST), 0, CONFIG, Logger(None, []), 0)
    learner.network = some_network()
    crystals = Crystals([(CONFIG.with_scenario(scenario), 16)])
    measured, batch = crystals.reset(range(16)), crystals.batches[0]
    slots = batch._batch.memory.slots
    slots["x"]["r_c"][:4] += 7.9e-3
    learner._follow(learner._drive(crystals, measured, torch.zeros(16, STATE)), batch.measured_by_state)
    found = [parameter.grad.clone() for parameter in learner.network.parameters() if parameter.grad is not None]
    state, measured = (torch.from_numpy(each) for each in batch.reset(range(16)))
    slots["x"]["r_c"][:4] += 7.9e-3
    memory, costs, step = torch.zeros(16, STATE), [], PlantStep.apply
    for _ in range(60):
        action, memory = learner.network(measured, memory)
        state, measured, terms = step(state, action, batch)
        costs.append(terms @ torch.from_numpy(learner.weights).float())
    assert 0 < batch.grows.sum() < 16
    whole = torch.stack(costs)
    loss: Any = (COST_CAP * whole / (COST_CAP + whole)).mean()
    wanted = torch.autograd.grad(loss, list(learner.network.parameters()))
    for ours, theirs in zip(found, wanted, strict=True):
        assert float((ours - theirs).norm()) <= 5e-5 * float(theirs.norm())


def test_a_move_that_a_limit_cuts_off_is_charged_as_asked_for() -> None:
    """On ``puller`` the pull speed moves by 0.025 mm/min in 5 s: where an action asks for more, the gradient is that of
    the cost without the limit; elsewhere it is the cost's own. A lost crystal has none."""
    config = CONFIG.with_scenario("puller")
    learner = GradientLearner(FEW, 0, CONFIG, Logger(None, []), 0)
    crystals = Crystals([(config, 4)])
    measured = crystals.reset(range(4))
    crystals.batches[0]._batch.memory.slots["x"]["r_c"][3] += 9e-3
    actions = np.array([[0.05, 0.0], [0.5, 0.0], [-0.5, 0.0], [0.5, 0.0]])
    step = crystals.step(actions)
    assert step.grows.tolist() == [True, True, True, False]
    found = learner._beyond(measured, actions, step)
    free = DifferentiableBatch(CONFIG, 4)
    free.reset(range(4))
    row, column = len(STATES) + Cost._fields.index("pull_step"), len(STATES)
    wanted = free.step(actions).jacobian[:, row, column]
    np.testing.assert_allclose(found, [0.0, wanted[1], wanted[2], 0.0], rtol=1e-4)
    assert step.jacobian[0, row, column] == pytest.approx(wanted[0], rel=1e-4)
    assert step.jacobian[1, row, column] == 0.0


@pytest.mark.parametrize(("scenario", "drives"), [("sensor-fault", (0, 1)), ("puller", (0,))])
def test_an_observable_cost_counts_what_sensors_can_show(scenario: str, drives: tuple[int, ...]) -> None:
    """With ``observable`` weights, the radius error less what no sensor shows is charged, and its derivatives are those
    of differences. The heater of ``puller`` moves in whole steps, which only differences see."""
    config, row = CONFIG.with_scenario(scenario), len(STATES) + Cost._fields.index("radius")
    learner = GradientLearner(replace(FEW, weights=LQG_COST, observable=True), 0, CONFIG, Logger(None, []), 0)

    def stepped(action: list[float]) -> Any:
        batch = DifferentiableBatch(config, 8)
        batch.reset(range(8))
        for _ in range(30):
            batch.step(np.full((8, 2), 0.05))
        true = batch.step(np.tile(action, (8, 1)))
        cost = true.cost.copy()
        return learner._weighed(true), cost

    step, true = stepped([0.06, 0.1])
    wanted = ((step.error + step.offset) / SCALES.radius) ** 2
    np.testing.assert_allclose(step.cost[:, 0], wanted, rtol=1e-12)
    np.testing.assert_array_equal(step.cost[:, 1:], true[:, 1:])
    assert float(np.abs(step.cost[:, 0] - true[:, 0]).max()) > 1e-3
    for place in drives:
        by = 0.01 * np.eye(2)[place]
        ends = [stepped((np.array([0.06, 0.1]) + sign * by).tolist())[0].cost[:, 0] for sign in (1, -1)]
        found = step.jacobian[:, row, len(STATES) + place]
        np.testing.assert_allclose(found, (ends[0] - ends[1]) / 0.02, rtol=1e-4, atol=1e-9)


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
    """After a step of the ring error its means rise as first-order lags and its integral grows."""
    network, memory = FilterBank(5.0, ()), torch.zeros(1, STATE)
    seen = torch.zeros(1, len(MEASURED))
    seen[0, [0, VALID]] = 1.0
    with torch.no_grad():
        for _ in range(100):
            features, memory = network.remember(seen, memory)
    times = np.array(filter_bank.TIMES)
    np.testing.assert_allclose(memory[0, : len(times)], 1.0 - np.exp(-500.0 / times), rtol=1e-4)
    assert float(memory[0, filter_bank.MEANS - 1]) == pytest.approx(0.5, rel=1e-4)
    np.testing.assert_allclose(features[0, : len(times) + 1].sum(), 1.0, rtol=1e-5)


def test_a_reading_that_failed_is_not_believed() -> None:
    """Its crystal's ring error counts as what it was, and not as a jump, noise, a ripple or an outlier; the estimate of
    the camera's noise waits."""
    network, memory = FilterBank(5.0, ()), torch.zeros(2, STATE)
    seen = torch.zeros(2, len(MEASURED))
    seen[:, 0], seen[:, VALID] = 0.5, 1.0
    ring = [*range(1 + len(filter_bank.TIMES)), *range(-11, 0)]
    with torch.no_grad():
        for k in range(300):
            seen[1, 0], seen[1, VALID] = (9.0, 0.0) if 200 <= k < 230 else (0.5, 1.0)
            features, memory = network.remember(seen, memory)
            torch.testing.assert_close(features[1, ring], features[0, ring], rtol=0.0, atol=0.05)


@pytest.mark.parametrize("deviation", [0.0, 0.003, 0.03, 0.1])
def test_the_noise_of_camera_and_pyrometer_is_estimated(deviation: float) -> None:
    """White noise on a ramp, with a jump in it: the variance is found but for a few per cent, by each channel alone."""
    network, memory = FilterBank(5.0, ()), torch.zeros(64, STATE)
    random, seen = np.random.default_rng(0), torch.zeros(64, len(MEASURED))
    seen[:, VALID] = 1.0
    pyrometer = [channel.name for channel in MEASURED].index("T_1")
    channels = len(filter_bank.NOISY)
    excess = slice(filter_bank.MEANS + 2 * channels, filter_bank.MEANS + 3 * channels)
    variances = []
    with torch.no_grad():
        for k in range(1500):
            seen[:, 0] = torch.from_numpy(0.001 * k + (k > 100) + deviation * random.normal(size=64))
            seen[:, pyrometer] = torch.from_numpy(0.02 * random.normal(size=64))
            features, memory = network.remember(seen, memory)
            variances.append(memory[:, excess].mean(dim=0) + filter_bank.USUAL**2)
    camera, pyrometer_too = (float(each) for each in torch.stack(variances[-600:]).mean(dim=0))
    assert camera == pytest.approx(deviation**2, rel=0.1, abs=1e-7)
    assert pyrometer_too == pytest.approx(0.02**2, rel=0.1)
    assert 0.0 < float(features[:, -5:-2].min()) < float(features[:, -5:-2].max()) < 1.0


def test_a_specialist_continues_from_the_agent_of_its_seed(tmp_path: Path) -> None:
    """Shipped, or in a folder of runs. It keeps the standardisation; a resumed run has weights of its own; any other
    agent is refused."""
    specialist: Any = RECIPES["gradient-specialist"]
    few = replace(specialist, num_envs=4, window=20, steps=4 * 20, whitened=False)
    shipped = agents.shipped_seeds("gradient")
    for seed in (0, 3):
        learner = GradientLearner(few, seed, few.config, Logger(None, []), 0)
        assert learner.exported() == shipped[seed].read_bytes()
    (tmp_path / "seed3").mkdir()
    for file in (shipped[3], shipped[3].with_suffix(".json")):
        shutil.copy(file, tmp_path / "seed3" / f"agent{file.suffix}")
    learner = GradientLearner(replace(few, start=str(tmp_path)), 3, few.config, Logger(None, []), 0)
    assert learner.exported() == shipped[3].read_bytes()
    mean = learner.network.mean.clone()
    learner.learn(lambda steps, doing: None)
    assert learner.exported() != shipped[3].read_bytes()
    assert torch.equal(learner.network.mean, mean)
    assert not GradientLearner(few, 0, few.config, Logger(None, []), 80).network.mean.any()
    for start, why in (("gradient", "gradient-seed77.onnx"), (str(agents.shipped_seeds("ppo")[0]), "not an agent")):
        with pytest.raises(AgentFileError, match=why):
            GradientLearner(replace(few, start=start), 77, few.config, Logger(None, []), 0)


def test_whitening_changes_what_is_learned_and_not_the_policy() -> None:
    """Before and after it the network acts alike; its state, and its agent file, are read by another learner."""
    recipe: Any = replace(RECIPES["gradient-specialist"], num_envs=4, window=20, steps=80)
    first, second = (GradientLearner(recipe, 0, recipe.config, Logger(None, []), 0) for _ in range(2))
    network = first.network
    width, random = len(network.mean), np.random.default_rng(0)
    features = torch.from_numpy(random.normal(size=(400, 3)) @ random.normal(size=(3, width))).float()
    features = network.mean + features / network.per_std
    before, learned = network.act(features).detach(), [weight.clone() for weight in network.parameters()]
    first._whiten(features, 0.0)
    first._whiten(features, 1.0)
    assert torch.allclose(network.act(features), before, atol=1e-4)
    assert not all(map(torch.equal, network.parameters(), learned))
    inputs = network.normalised(features)[:, : -filter_bank.N_DETACHED].double()
    scaling = first.whitened[0][1].scaling[: -filter_bank.N_DETACHED, : -filter_bank.N_DETACHED].double()
    strengths = torch.linalg.svdvals(inputs @ scaling) / 20.0
    assert strengths[:3].numpy() == pytest.approx(1.0, abs=0.05)
    assert float(strengths[3]) < 1e-2
    second.network.load_state_dict(network.state_dict())
    assert second.exported() == first.exported()


def test_it_learns_from_nothing() -> None:
    """Forty updates on a third of the recipe's crystals: from losing all crystals to holding most of them."""
    recipe: Any = replace(RECIPES["gradient-start"], num_envs=64, steps=64 * 180 * 40, hidden=(), mixture=())
    learner, config = GradientLearner(recipe, 0, recipe.config, Logger(None, []), 0), recipe.config

    def judged() -> Validation:
        content = learner.exported()
        contract = make_contract(content, **{**facts(), **facts_of(config), "channels": len(MEASURED)})
        return validate(OnnxPolicy.of(contract, content, config), config, VALIDATION_SEEDS[:16])

    assert judged().failure_rate > 0.8
    learner.learn(lambda steps, doing: None)
    assert learner.steps == learner.total == 64 * 180 * 40
    assert judged().failure_rate < 0.3
