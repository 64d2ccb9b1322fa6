"""Train stable-baselines3's own PPO on Cz-v0, from nothing, by reward: ``python -m cz_gym.examples.sb3_ppo``.

``cz-gym benchmark --agent runs/sb3-ppo.onnx`` puts the agent into the table.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

from cz_gym.agents.contract import Contract
from cz_gym.agents.from_sb3 import save_agent
from cz_gym.sb3 import make_vec_env


def main(seed: int = 0, steps: int = 36_000_000, out: Path = Path("runs/sb3-ppo.onnx")) -> Contract:
    """Train on every scenario, write the agent file, and judge it on 200 validation crystals."""
    torch.set_num_threads(1)  # small networks are quicker so
    env = VecNormalize(make_vec_env(1024, stagger=seed, action_repeat=4, scenario="all"), norm_obs=False)
    settings: Any = {"n_steps": 64, "batch_size": 2048, "n_epochs": 5, "policy_kwargs": {"log_std_init": -0.7}}
    model = PPO("MlpPolicy", env, lambda left: 1e-3 * left, seed=seed, device="cpu", **settings)
    model.learn(steps // 4, progress_bar=sys.stderr.isatty())
    return save_agent(out, model, "sb3-ppo")


if __name__ == "__main__":
    parser = argparse.ArgumentParser("python -m cz_gym.examples.sb3_ppo", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("seed", nargs="?", type=int, default=0, help="training seed (default: 0)")
    print(f"radius error {main(parser.parse_args().seed).validation_rmse_mm:.3f} mm on validation crystals")
