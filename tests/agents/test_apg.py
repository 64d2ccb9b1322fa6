"""Analytic policy gradients: the gradient is that of differences, and the interface stable-baselines3's."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from stable_baselines3.common.env_util import make_vec_env as scalar_environments
from stable_baselines3.common.logger import configure

from cz_gym import agents
from cz_gym.agents.apg import APG, StepCost, advance, mean_square
from cz_gym.agents.recipes import RECIPES, make_algorithm
from cz_gym.agents.window import Window
from cz_gym.body.signals import SCALES, WEIGHTS, saturated
from cz_gym.config import make_config
from cz_gym.crystal.process import CRYSTAL
from cz_gym.engine.tangents import STATES, DifferentiableBatch
from cz_gym.evaluation.protocol import scenarios
from cz_gym.sb3 import make_vec_env
from cz_gym.support.errors import CzError

SETTINGS = {"observation": "measured", "action": "rate"}
CONFIG = make_config(**SETTINGS)
ALONG = {"stage": {"crown": 2, "body": 1, "tail": 1}}
CRYSTALS = make_config(process=CRYSTAL, **ALONG, **SETTINGS)


def algorithm(n=8, window=20, seed=0, env="Cz-v0", **options):
    torch.set_num_threads(1)
    settings = SETTINGS | (ALONG if env == "CzCrystal-v0" else {})
    return APG("RecurrentPolicy", make_vec_env(n, env=env, **settings), window=window, seed=seed, **options)


def some_policy(env="Cz-v0"):
    """A policy with random weights, which moves both drives a little."""
    torch.manual_seed(0)
    policy = algorithm(env=env).policy
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.copy_(0.05 * torch.randn_like(parameter))
        policy.mean.copy_(0.01 * torch.randn_like(policy.mean))
        policy.std.copy_(1.0 + torch.rand_like(policy.std))
    return policy


def driven(policy, batch, steps):
    """Mean cost of crystals that the policy drives."""
    state, measured = map(torch.from_numpy, batch.reset(range(batch.num_envs)))
    memory, cost_of, costs = policy.initial_memory(batch.num_envs), StepCost(batch), []
    for _ in range(steps):
        action, memory = policy(measured, memory)
        before = state
        state, measured, grows, target = advance(before, action, batch)
        costs.append(cost_of(before, action, state, grows, target))
    return torch.stack(costs).mean()


@pytest.mark.parametrize(
    ("scenario", "apart", "config"),
    [
        ("randomized", 0.01, CONFIG), ("sensor-fault", 0.01, CONFIG), ("puller", 0.05, CONFIG),
        pytest.param("randomized", 0.01, CRYSTALS, marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_the_gradient_is_that_of_differences(scenario, apart, config):
    """Along a random direction of all weights, through 40 steps of plant, sensors, memory and policy.

    The heater of ``puller`` moves in whole steps, which differences see and the gradient does not.
    """
    policy, batch = some_policy(config.process.name), DifferentiableBatch(config.with_scenario(scenario), 12)
    driven(policy, batch, 40).backward()
    parameters = list(policy.parameters())
    directions = [torch.randn_like(parameter) for parameter in parameters]
    along = sum(float((one.grad * by).sum()) for one, by in zip(parameters, directions, strict=True))
    costs = []
    with torch.no_grad():
        for share in (2e-3, -4e-3):
            for parameter, direction in zip(parameters, directions, strict=True):
                parameter += share * direction
            costs.append(float(driven(policy, batch, 40)))
    assert along == pytest.approx((costs[0] - costs[1]) / 4e-3, rel=apart)


@pytest.mark.parametrize(
    ("scenario", "config"),
    [
        ("all", CONFIG), ("puller", CONFIG),
        *(pytest.param(name, CRYSTALS, marks=pytest.mark.slow) for name in ("sensor-fault", "randomized")),
    ],
)  # fmt: skip
def test_the_written_out_gradient_is_autograd_s(scenario, config):
    """Of every weight, through lost crystals, clipped features and held readings too."""
    policy, scene = some_policy(config.process.name), scenarios(scenario)
    policy.std[:3] = 1e-3
    with torch.no_grad():
        policy.linear.weight *= 4.0
    cost = driven(policy, DifferentiableBatch(config.with_scenario(scene), 12), 60)
    cost.backward()
    wanted = {name: parameter.grad.clone() for name, parameter in policy.named_parameters()}
    batch = DifferentiableBatch(config.with_scenario(scene), 12)
    window, (state, measured) = Window(policy, StepCost(batch), batch, 60), batch.reset(range(12))
    window.begin(torch.from_numpy(state), policy.initial_memory(12))
    for _ in range(60):
        step = batch.step(window.act(torch.from_numpy(measured)).numpy())
        measured = step.measured
        window.record(step)
    assert window.backward() == pytest.approx(cost.item(), rel=1e-6)
    for name, parameter in policy.named_parameters():
        assert float((parameter.grad - wanted[name]).norm()) < 1e-4 * float(wanted[name].norm()), name


def stepped(scenario, action, actions):
    """States before and after a step of four crystals, the actions, the batch's own record of it, and the cost."""
    config = make_config(scenario, observation="measured", action=action)
    batch, twin = (DifferentiableBatch(config, 4) for _ in range(2))
    for each in (batch, twin):
        each.reset(range(4))
        for _ in range(30):
            each.step(np.full((4, 2), 0.02))
    before = torch.from_numpy(twin._state)
    after = advance(before, torch.from_numpy(np.float32(actions)), twin)
    return before, after, torch.from_numpy(np.float32(actions)), batch.step(actions), StepCost(twin)


@pytest.mark.parametrize("action", ["rate", "smooth", "direct"])
def test_the_cost_is_the_environment_s(action):
    before, (after, _, grows, target), actions, step, cost_of = stepped("sensor-fault", action, np.full((4, 2), 0.05))
    assert np.abs(step.offset).max() > 1e-6
    wanted = saturated(step.cost.sum(axis=1))
    np.testing.assert_allclose(cost_of(before, actions, after, grows, target), wanted, rtol=1e-5)


def test_a_pull_step_that_a_limit_cuts_is_charged_as_asked():
    """On ``puller`` the pull speed moves by 0.025 mm/min in 5 s: its cost and derivative go on beyond."""
    asked = np.array([[0.05, 0.0], [0.5, 0.0], [-0.5, 0.0], [1.0, 0.0]])
    before, (after, _, grows, target), actions, step, cost_of = stepped("puller", "rate", asked)
    assert np.abs(step.jacobian[1:, len(STATES) + 2, len(STATES)]).max() == 0.0, "no limit cuts these"
    actions.requires_grad_()
    cost = cost_of(before, actions, after, grows, target)
    pull = 0.1 * CONFIG.parameters.v_0 * asked[:, 0]
    asked_for = step.cost.sum(axis=1) - step.cost[:, 2] + WEIGHTS.pull_step * (pull / SCALES.pull_step) ** 2
    np.testing.assert_allclose(cost.detach(), saturated(asked_for), rtol=1e-5)
    cost.sum().backward()
    assert actions.grad is not None
    np.testing.assert_array_equal(np.sign(actions.grad[:, 0].numpy()), np.sign(asked[:, 0]))


def test_a_rounded_move_costs_its_mean_square_over_all_places_that_it_may_begin_at():
    """The oracle rounds: 10,000 places within a step."""
    begin, move = np.linspace(0.0, 100.0, 10_000, endpoint=False), np.array([0.0, 3.0, -40.0, 100.0, 270.0, -7.0])
    rounded = 100.0 * (np.rint((begin[:, None] + move) / 100.0) - np.rint(begin[:, None] / 100.0))
    whole = torch.tensor([100.0] * 5 + [0.0], dtype=torch.float64)
    wanted = np.append((rounded**2).mean(axis=0)[:5], move[5] ** 2)
    np.testing.assert_allclose(mean_square(torch.from_numpy(move), whole), wanted, rtol=1e-3)


def test_a_lost_crystal_costs_nothing_and_has_no_gradient():
    batch = DifferentiableBatch(CONFIG, 2)
    state, _ = map(torch.from_numpy, batch.reset(range(2)))
    batch._batch.memory.slots["x"]["r_c"][1] += 9e-3
    action = torch.zeros(2, 2, requires_grad=True)
    after, _, grows, target = advance(state, action, batch)
    cost = StepCost(batch)(state, action, after, grows, target)
    cost.sum().backward()
    assert grows.tolist() == [True, False]
    assert cost[1] == 0.0 < cost[0]
    assert action.grad is not None
    assert not action.grad[1].any()


def test_predict_is_the_network_step_by_step_and_forgets_where_an_episode_begins():
    policy = some_policy()
    random, state, memory = np.random.default_rng(0), None, policy.initial_memory(3)
    for step in range(12):
        starts = np.array([step == 0, step == 0, step == 6])
        seen = random.normal(0.0, 0.3, (3, 12)).astype(np.float32)
        memory[starts] = 0.0
        with torch.no_grad():
            wanted, memory = policy(torch.from_numpy(seen), memory)
        action, state = policy.predict(seen, state, starts)
        np.testing.assert_array_equal(action, wanted.clamp(-1.0, 1.0))
    single, _ = policy.predict(seen[0], None, True)
    assert single.shape == (2,)


def parameters_of(model):
    return torch.cat([each.flatten() for each in model.policy.parameters()])


def test_a_saved_model_acts_and_goes_on_as_it_did(tmp_path):
    model = algorithm().learn(320)
    model.save(tmp_path / "model.zip")
    again = APG.load(tmp_path / "model.zip", env=make_vec_env(8, **SETTINGS))
    assert (again.num_timesteps, again.window) == (320, 20)
    seen = np.random.default_rng(0).normal(size=(4, 12)).astype(np.float32)
    np.testing.assert_array_equal(again.predict(seen)[0], model.predict(seen)[0])
    for each in (model, again):
        each.learn(320, reset_num_timesteps=False)
        assert each.num_timesteps == 640
    assert torch.equal(parameters_of(again), parameters_of(model))


def test_callbacks_see_every_step_and_end_the_training():
    seen = []

    def callback(known, _):
        seen.append(known["self"].num_timesteps)
        return len(seen) < 5

    assert algorithm().learn(10_000, callback).num_timesteps == 160
    assert seen[:5] == [8, 16, 24, 32, 40]


def test_two_seeds_learn_from_other_crystals_and_one_seed_repeats():
    first, again, other = (parameters_of(algorithm(seed=seed).learn(160)) for seed in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


@pytest.mark.parametrize(
    ("env", "said"),
    [
        (lambda: "CartPole-v1", "env must be made of these"),
        (lambda: make_vec_env(2, observation="history"), "reads observation=\"measured\".*not 'history'"),
    ],
)
def test_another_environment_is_refused(env, said):
    with pytest.raises(CzError, match=said):
        APG("RecurrentPolicy", env())


def test_scalar_environments_learn_too():
    env = scalar_environments("Cz-v0", n_envs=2, env_kwargs=SETTINGS)
    assert APG("RecurrentPolicy", env, window=10).learn(40).num_timesteps == 40


@pytest.mark.slow
def test_apg_lowers_the_cost_in_a_few_updates():
    """On the same crystals before and after: from losing them to following the reference for an hour."""
    model, batch = algorithm(24, 90), DifferentiableBatch(CONFIG, 24)
    before = driven(model.policy, batch, 720).item()
    model.learn(24 * 90 * 60)
    assert driven(model.policy, batch, 720).item() < 0.5 * before


def test_a_training_goes_on_from_an_agents_weights(tmp_path):
    """Before the first update the policy acts as the agent does, and the features keep their statistics."""
    recipe = replace(RECIPES["gradient"], start=str(agents.shipped("gradient")), num_envs=8)
    begun, agent = make_algorithm(recipe, 0), agents.load("gradient")
    seen = np.random.default_rng(0).normal(0.0, 0.1, (4, 12)).astype(np.float32)
    memory, mean = np.full((4, 160), 0.1, np.float32), begun.policy.mean.clone()
    np.testing.assert_allclose(begun.predict(seen, memory)[0], agent.predict(seen, memory)[0], atol=1e-6)
    assert begun.warm_up == 0.0
    assert recipe.steps_before == agent.contract.training_steps
    begun.set_logger(configure(None, []))
    begun.learn(8 * 180)
    assert torch.equal(begun.policy.mean, mean)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"units": 64}, "a memory of 128 units, not 64: --set units=128"),
        ({"start": str(agents.shipped("ppo"))}, "its observation is history, the recipe's is measured"),
        ({"start": str(agents.shipped("gradient-along"))}, "its environment is CzCrystal-v0, the recipe's is Cz-v0"),
        ({"start": "nobody.onnx"}, "no such file"),
    ],
)
def test_an_agent_that_cannot_be_learned_on_is_refused(fields, message):
    """In one line that says what differs."""
    with pytest.raises(CzError, match=message):
        make_algorithm(
            replace(RECIPES["gradient"], **{"start": str(agents.shipped("gradient")), "num_envs": 8} | fields), 0
        )
