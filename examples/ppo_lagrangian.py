"""Train PPO under a constraint, few steps out of tolerance: ``python -m cz_gym.examples.ppo_lagrangian``.

A Lagrange multiplier is the price of such a step: it rises while their share is above the limit, and falls below.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import torch
from gymnasium.vector import AutoresetMode
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnvWrapper, VecNormalize

from cz_gym import CzVectorEnv
from cz_gym.agents.contract import Contract
from cz_gym.agents.from_sb3 import save_agent
from cz_gym.sb3 import ActionRepeat, CzVecEnv

LIMIT = 0.05
"""Largest share of steps out of tolerance [-]."""
RATE = 0.1
"""Rise of the multiplier after each rollout, per share above the limit [-]."""


class Priced(VecEnvWrapper):
    """Subtracts the price of each step out of tolerance from its reward."""

    def __init__(self, venv: CzVecEnv) -> None:
        super().__init__(venv)
        self.crystals, self.multiplier, self.outside, self.steps = venv, 0.0, 0.0, 0

    def reset(self) -> Any:
        """Reset every slot."""
        return self.venv.reset()

    def step_wait(self) -> Any:
        """Advance every slot."""
        observation, reward, done, infos = self.venv.step_wait()
        cost = self.crystals.cost.astype(reward.dtype)
        self.outside, self.steps = self.outside + cost.sum(), self.steps + len(cost)
        return observation, reward - self.multiplier * cost, done, infos


class DualAscent(BaseCallback):
    """Moves the multiplier after each rollout by how far the share of steps out of tolerance is from its limit."""

    def __init__(self, priced: Priced) -> None:
        super().__init__()
        self.priced = priced

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        priced, share = self.priced, self.priced.outside / self.priced.steps
        priced.multiplier = max(priced.multiplier + RATE * (share - LIMIT), 0.0)
        priced.outside, priced.steps = 0.0, 0
        self.logger.record("constraint/share_outside", share)
        self.logger.record("constraint/multiplier", priced.multiplier)


def main(
    seed: int = 0, steps: int = 36_000_000, num_envs: int = 1024, out: Path = Path("runs/ppo-lagrangian.onnx")
) -> tuple[Contract, float]:
    """Train on every scenario and write the agent file; returns its contract and the multiplier at the end."""
    torch.set_num_threads(1)  # small networks are quicker so
    crystals = CzVectorEnv(num_envs, "all", autoreset_mode=AutoresetMode.SAME_STEP)
    priced = Priced(CzVecEnv(crystals, stagger=seed))
    env = VecNormalize(ActionRepeat(priced, 4), norm_obs=False)
    settings: Any = {"n_steps": 64, "batch_size": 2 * num_envs, "n_epochs": 5, "policy_kwargs": {"log_std_init": -0.7}}
    model = PPO("MlpPolicy", env, lambda left: 1e-3 * left, seed=seed, device="cpu", **settings)
    model.learn(steps // 4, DualAscent(priced), progress_bar=sys.stderr.isatty())
    model.set_env(ActionRepeat(priced.crystals, 4))  # the prices are no part of the agent
    return save_agent(out, model, "ppo-lagrangian", env), priced.multiplier


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        "python -m cz_gym.examples.ppo_lagrangian", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("seed", nargs="?", type=int, default=0, help="training seed (default: 0)")
    contract, multiplier = main(parser.parse_args().seed)
    print(f"radius error {contract.validation_rmse_mm:.3f} mm on validation crystals; multiplier {multiplier:.2f}")
