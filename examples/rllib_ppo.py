"""Train RLlib's PPO on the native batch, from nothing, by reward: ``python -m examples.rllib_ppo``, 5 minutes.

It needs more than ``make venv`` installs: ``pip install "ray[rllib]"``, which is too large for the test suite.
It prints what the agent is worth on validation crystals while it learns.
"""

from __future__ import annotations

import argparse
import sys
import time
from typing import Any

try:
    import numpy as np
    import ray
    import torch
    from gymnasium.vector import VectorWrapper
    from gymnasium.wrappers.vector import NormalizeObservation, TransformReward
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.rllib.core.columns import Columns
    from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
    from ray.tune.registry import register_env
except ModuleNotFoundError as error:
    sys.exit(f"{error.name} is missing: .venv/bin/python -m pip install 'ray[rllib]' torch")

from cz_gym import CzVectorEnv
from cz_gym.agents.training.validation import Validation, validate
from cz_gym.config import make_config
from cz_gym.evaluation.protocol import VALIDATION_SEEDS

CONFIG = make_config("randomized")
GAMMA = 0.99


def crystals(settings: Any) -> VectorWrapper:
    """The batch that RLlib steps: observations normalised, rewards times 1 - gamma."""
    batch = CzVectorEnv.from_config(CONFIG, settings["num_envs"])
    return NormalizeObservation(TransformReward(batch, lambda reward: (1.0 - GAMMA) * reward))


class Policy:
    """RLlib's module without exploration, as rollouts and the benchmark call it."""

    def __init__(self, runner: Any) -> None:
        self.module, env = runner.module, runner.env
        while not isinstance(env, NormalizeObservation):
            env = env.env
        self.mean, self.std = env.obs_rms.mean.copy(), np.sqrt(env.obs_rms.var + env.epsilon)

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Any:
        """Observations (n, channels) -> mean actions (n, 2), and no state."""
        seen = torch.as_tensor(((observation - self.mean) / self.std).astype(np.float32))
        with torch.no_grad():
            outputs = self.module.forward_inference({Columns.OBS: seen})[Columns.ACTION_DIST_INPUTS]
        return outputs[:, :2].clamp(-1.0, 1.0).numpy(), state


def main(seed: int = 0, steps: int = 3_000_000, slots: int = 128) -> Validation:
    """Learn for that many steps, and say every tenth of them what the agent is worth; the last judgement."""
    ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False)
    fragment = 64
    register_env("crystals", crystals)
    settings = PPOConfig().environment("crystals").debugging(seed=seed)
    settings.env_runners(num_env_runners=0, num_envs_per_env_runner=slots, rollout_fragment_length=fragment)
    settings.env_runners(gym_env_vectorize_mode="vector_entry_point")
    settings.training(train_batch_size_per_learner=fragment * slots, minibatch_size=2048, num_epochs=5)
    settings.training(lr=[[0, 1e-3], [steps, 1e-5]], gamma=GAMMA, lambda_=0.95, clip_param=0.2, grad_clip=0.5)
    settings.training(vf_loss_coeff=0.5, vf_clip_param=1e3, use_kl_loss=False, entropy_coeff=0.0)
    network: Any = {"fcnet_hiddens": [64, 64], "fcnet_activation": "tanh", "vf_share_layers": False}
    settings.rl_module(model_config=DefaultModelConfig(free_log_std=True, **network))
    algorithm = settings.build_algo()
    began, done, said = time.monotonic(), 0, 0
    while done < steps:
        done = algorithm.train()["env_runners"]["num_env_steps_sampled_lifetime"]
        if done >= said + steps / 10 or done >= steps:
            said = done
            found = validate(Policy(algorithm.env_runner), CONFIG, VALIDATION_SEEDS[:100])
            minutes, lost = (time.monotonic() - began) / 60.0, 100.0 * found.failure_rate
            print(f"{done:>9,.0f} steps, {minutes:.1f} min: ", end="")
            print(f"radius error {found.rmse_mm:.3f} mm, {lost:.0f} % of crystals lost", flush=True)
    algorithm.stop()
    ray.shutdown()
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    for name, value in {"seed": 0, "steps": 3_000_000, "slots": 128}.items():
        parser.add_argument(f"--{name}", type=int, default=value)
    main(**vars(parser.parse_args()))
