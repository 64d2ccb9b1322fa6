"""From a loop of another library to an agent file: ``python -m cz_gym.examples.anywhere cleanrl --minutes 10``.

Each function trains in the manner of a library and keeps its networks as that library does; the last lines hand the
deterministic actor to :func:`cz_gym.agents.save_agent`. Minutes are of processor time, with one thread.
"""

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import nn

from cz_gym import CzVectorEnv
from cz_gym.agents.from_torch import save_agent
from cz_gym.config import make_config
from cz_gym.support.command_line import OneLineParser, between

CHANNELS, REPEAT, GAMMA, CLIP = 73, 4, 0.99, 0.2


@dataclass
class Budget:
    """Limits of a training: minutes of processor time, and crystals at once."""

    minutes: float
    crystals: int = 1024
    began: float = field(default_factory=time.process_time)
    steps: int = 0
    """Environment steps so far, each repeat of an action counted."""

    @property
    def left(self) -> float:
        """Share that is left."""
        return max(1.0 - (time.process_time() - self.began) / (60.0 * self.minutes), 0.0)

    def environments(self, scenario: str = "all") -> Any:
        """The native batch, each action held for four steps."""
        options: dict[str, Any] = {"autoreset_mode": "SameStep", "scenario": scenario, "action_repeat": REPEAT}
        return CzVectorEnv(self.crystals, **options)


class Scale:
    """Divides rewards by the spread of their running discounted sums, as a wrapper of Gymnasium does."""

    def __init__(self, crystals: int) -> None:
        self.sums, self.square, self.count = torch.zeros(crystals), 1.0, 1e-4

    def __call__(self, reward: torch.Tensor, end: torch.Tensor) -> torch.Tensor:
        """Return the scaled rewards of a step; sums begin anew where an episode ended."""
        self.sums = self.sums * GAMMA + reward
        self.count += 1.0
        self.square += (self.sums.square().mean().item() - self.square) / self.count
        self.sums = self.sums * ~end
        scaled: torch.Tensor = (reward / self.square**0.5).clamp(-10.0, 10.0)
        return scaled


Function = Callable[[torch.Tensor], torch.Tensor]


def ppo(
    budget: Budget, mean: Function, value: Function, weights: Sequence[torch.Tensor], seed: int, watch: Any = None
) -> None:
    """Proximal policy optimisation of a Gaussian policy, in one loop; ``watch`` sees every batch of observations."""
    log_sd = torch.full((2,), -0.7, requires_grad=True)
    optimiser = torch.optim.Adam([*weights, log_sd], 1e-3, eps=1e-5)
    envs, steps, scale = budget.environments(), 64, Scale(budget.crystals)
    seen = torch.tensor(envs.reset(seed=seed)[0])
    while budget.left:
        for group in optimiser.param_groups:
            group["lr"] = 1e-3 * budget.left
        rows = []
        for _ in range(steps):
            if watch:
                watch(seen)
            with torch.no_grad():
                policy: Any = torch.distributions.Normal(mean(seen), log_sd.exp())
                action, worth = policy.sample(), value(seen)
            following, reward, lost, late, _ = envs.step(action.numpy())
            end = torch.tensor(lost | late)
            earned = scale(torch.tensor(reward, dtype=torch.float32), end)
            rows.append((seen, action, policy.log_prob(action).sum(-1), worth, earned, end))
            seen = torch.tensor(following)
        budget.steps += steps * budget.crystals * REPEAT
        update(rows, value(seen).detach(), mean, value, log_sd, optimiser)
    envs.close()


def update(rows: Any, later: Any, mean: Any, value: Any, log_sd: Any, optimiser: torch.optim.Optimizer) -> None:
    """Five passes over a rollout with its generalised advantages."""
    observed, acted, before, values, rewards, ends = map(torch.stack, zip(*rows, strict=True))
    gains, gain = torch.zeros_like(values), torch.zeros_like(later)
    for k in reversed(range(len(values))):
        gains[k] = gain = rewards[k] + ~ends[k] * GAMMA * (later + 0.95 * gain) - values[k]
        later = values[k]
    flat = [part.flatten(0, 1) for part in (observed, acted, before, gains, gains + values)]
    for _ in range(5):
        order: Any = torch.randperm(len(flat[0]))
        for chosen in order.split(2048):
            o, a, b, g, target = (part[chosen] for part in flat)
            policy: Any = torch.distributions.Normal(mean(o), log_sd.exp())
            ratio = (policy.log_prob(a).sum(-1) - b).exp()
            g = (g - g.mean()) / (g.std() + 1e-8)
            loss = -torch.min(ratio * g, ratio.clamp(1.0 - CLIP, 1.0 + CLIP) * g).mean()
            loss = loss + 0.5 * (value(o) - target).square().mean()
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_([each for group in optimiser.param_groups for each in group["params"]], 0.5)
            optimiser.step()


def mlp(outputs: int) -> nn.Sequential:
    """Two hidden layers."""
    return nn.Sequential(nn.Linear(CHANNELS, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, outputs))


def cleanrl(budget: Budget, seed: int = 0) -> nn.Module:
    """One file, one class with ``actor_mean`` and ``critic``: the actor's mean is the agent."""

    class Agent(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.actor_mean, self.critic = mlp(2), nn.Sequential(mlp(1), nn.Flatten(0))

    agent = Agent()
    ppo(budget, agent.actor_mean, agent.critic, list(agent.parameters()), seed)
    return agent.actor_mean


def skrl(budget: Budget, seed: int = 0) -> nn.Module:
    """Agent, memory and trainer of skrl: the scaler of observations and the policy's network go into the module."""
    from gymnasium.wrappers.vector import NormalizeReward
    from skrl.agents.torch.ppo import PPO
    from skrl.envs.wrappers.torch import wrap_env
    from skrl.memories.torch import RandomMemory
    from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
    from skrl.resources.preprocessors.torch import RunningStandardScaler
    from skrl.trainers.torch import SequentialTrainer
    from skrl.utils import set_seed

    class Policy(GaussianMixin, Model):  # type: ignore[misc]
        def __init__(self, **spaces: Any) -> None:
            Model.__init__(self, **spaces)
            GaussianMixin.__init__(self)
            self.net, self.log_sd = mlp(2), nn.Parameter(torch.full((2,), -0.7))

        def compute(self, inputs: dict[str, torch.Tensor], role: str) -> Any:
            return self.net(inputs["observations"]), {"log_std": self.log_sd}

    class Value(DeterministicMixin, Model):  # type: ignore[misc]
        def __init__(self, **spaces: Any) -> None:
            Model.__init__(self, **spaces)
            DeterministicMixin.__init__(self)
            self.net = mlp(1)

        def compute(self, inputs: dict[str, torch.Tensor], role: str) -> Any:
            return self.net(inputs["observations"]), {}

    set_seed(seed)
    steps, env = 64, wrap_env(NormalizeReward(budget.environments(), GAMMA), wrapper="gymnasium", verbose=False)
    spaces = {"observation_space": env.observation_space, "action_space": env.action_space, "device": "cpu"}
    policy = Policy(**spaces)
    settings = {
        "rollouts": steps, "learning_epochs": 5, "mini_batches": max(steps * budget.crystals // 2048, 1),
        "discount_factor": GAMMA, "gae_lambda": 0.95, "ratio_clip": CLIP, "value_clip": 0.0, "value_loss_scale": 0.5,
        "learning_rate": 1e-3, "learning_rate_scheduler": torch.optim.lr_scheduler.LambdaLR,
        "learning_rate_scheduler_kwargs": {"lr_lambda": lambda _: budget.left},
        "observation_preprocessor": RunningStandardScaler,
        "observation_preprocessor_kwargs": {"size": env.observation_space, "device": "cpu"},
        "rewards_shaper": lambda rewards, *_: rewards.clamp(-10.0, 10.0),
        "experiment": {"write_interval": 0, "checkpoint_interval": 0},
    }  # fmt: skip
    memory = RandomMemory(memory_size=steps, num_envs=budget.crystals, device="cpu")
    agent = PPO(models={"policy": policy, "value": Value(**spaces)}, memory=memory, cfg=settings, **spaces)
    own = {"timesteps": steps, "headless": True, "disable_progressbar": True, "close_environment_at_exit": False}
    trainer = SequentialTrainer(env=env, agents=agent, cfg=own)
    while budget.left:
        trainer.train()
        agent.tracking_data.clear()
        budget.steps += steps * budget.crystals * REPEAT
    env.close()
    return nn.Sequential(agent._observation_preprocessor, policy.net)


def sbx(budget: Budget, seed: int = 0) -> nn.Module:
    """Weights in nested dictionaries of kernels (inputs, outputs), as JAX's libraries keep them, are transposed."""

    def params(outputs: int) -> dict[str, dict[str, torch.Tensor]]:
        layers = [each for each in mlp(outputs) if isinstance(each, nn.Linear)]
        pairs = [{"kernel": each.weight.detach().T, "bias": each.bias.detach()} for each in layers]
        return {
            f"Dense_{i}": {name: array.clone().requires_grad_() for name, array in pair.items()}
            for i, pair in enumerate(pairs)
        }

    def apply(params: dict[str, dict[str, torch.Tensor]], x: torch.Tensor) -> torch.Tensor:
        for name, layer in params.items():
            x = x @ layer["kernel"] + layer["bias"]
            x = x if name == f"Dense_{len(params) - 1}" else torch.tanh(x)
        return x

    actor, critic = params(2), params(1)
    weights = [array for tree in (actor, critic) for layer in tree.values() for array in layer.values()]
    ppo(budget, lambda x: apply(actor, x), lambda x: apply(critic, x).flatten(), weights, seed)
    module = mlp(2)
    for own, layer in zip((each for each in module if isinstance(each, nn.Linear)), actor.values(), strict=True):
        own.weight.data, own.bias.data = layer["kernel"].detach().T.contiguous(), layer["bias"].detach()
    return module


def torchrl(budget: Budget, seed: int = 0) -> nn.Module:
    """A collector, and losses that read dictionaries of tensors: the network that gives ``loc`` is the agent."""
    from tensordict.nn import NormalParamExtractor, TensorDictModule
    from torchrl.collectors import Collector
    from torchrl.envs import GymWrapper
    from torchrl.modules import IndependentNormal, ProbabilisticActor, ValueOperator
    from torchrl.objectives import ClipPPOLoss
    from torchrl.objectives.value import GAE

    steps, network = 64, nn.Sequential(mlp(4), NormalParamExtractor(scale_lb=0.05))
    module: Any = TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"])
    actor: Any = ProbabilisticActor(
        module, in_keys=["loc", "scale"], distribution_class=IndependentNormal, return_log_prob=True
    )
    critic: Any = ValueOperator(mlp(1))
    advantage: Any = GAE(gamma=GAMMA, lmbda=0.95, value_network=critic)
    loss: Any = ClipPPOLoss(actor, critic, clip_epsilon=CLIP, entropy_bonus=False, normalize_advantage=True)
    optimiser = torch.optim.Adam(loss.parameters(), 1e-3, eps=1e-5)
    # TorchRL takes numbers from infos, and a mixture's have a name.
    env, scale = GymWrapper(budget.environments("randomized")), Scale(budget.crystals)
    env.set_seed(seed)
    options = {"frames_per_batch": steps * budget.crystals, "total_frames": -1, "auto_register_policy_transforms": True}
    collector: Any = Collector(env, actor, **options)
    for batch in collector:
        if not budget.left:
            break
        for group in optimiser.param_groups:
            group["lr"] = 1e-3 * budget.left
        budget.steps += batch.numel() * REPEAT
        reward, end = batch["next", "reward"], batch["next", "done"]
        for k in range(reward.shape[1]):
            reward[:, k, 0] = scale(reward[:, k, 0], end[:, k, 0])
        with torch.no_grad():
            advantage(batch)
        for _ in range(5):
            for part in (flat := batch.reshape(-1))[torch.randperm(len(flat))].split(2048):
                terms = loss(part)
                optimiser.zero_grad()
                (terms["loss_objective"] + 0.5 * terms["loss_critic"]).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                optimiser.step()

    class Mean(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.inner = network

        def forward(self, x: torch.Tensor) -> Any:
            return self.inner(x)[0]

    return Mean()


LOOPS = {"cleanrl": cleanrl, "skrl": skrl, "sbx": sbx, "torchrl": torchrl}
"""The manners, by name."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Train in a manner and write the agent file; returns the exit code."""
    about = "Train in the manner of a library; write an agent file."
    parser = OneLineParser("python -m cz_gym.examples.anywhere", about)
    parser.add_argument("manner", choices=LOOPS)
    parser.add_argument("--minutes", type=float, default=10.0, help="processor time (%(default)s)")
    parser.add_argument("--crystals", type=between(1, 10**6), default=1024, help="crystals at once (%(default)s)")
    parser.add_argument("--seed", type=between(0, 2**32 - 1), default=0, help="training seed (%(default)s)")
    parser.add_argument("--out", type=Path, metavar="FILE.onnx", help="agent file (runs/MANNER.onnx)")
    return parser.run(_main, arguments, "agents")


def _main(given: argparse.Namespace) -> None:
    torch.set_num_threads(1)
    torch.manual_seed(given.seed)
    path = given.out or Path("runs") / f"{given.manner}.onnx"
    config = make_config("randomized" if given.manner == "torchrl" else "all")
    budget = Budget(given.minutes, given.crystals)
    module = LOOPS[given.manner](budget, given.seed)
    contract = save_agent(path, module, config, training_steps=budget.steps, training_seed=given.seed)
    print(f"wrote {path}: {budget.steps:,} steps, {contract.validation_rmse_mm:.3f} mm on 200 validation crystals")


if __name__ == "__main__":
    sys.exit(main())
