"""Train stable-baselines3's own PPO on Cz-v0, from nothing, by reward: ``python -m examples.sb3_ppo``, 4 minutes.

Then judge it on validation crystals. ``python benchmark.py --agent runs/sb3-ppo.onnx`` puts the agent into the table.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

try:
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecNormalize
except ModuleNotFoundError as error:
    sys.exit(f'{error.name} is missing: make venv, then .venv/bin/python, or pip install ".[agents]"')

from cz_gym.agents import load
from cz_gym.agents.from_sb3 import save_agent
from cz_gym.agents.training.validation import Validation, validate
from cz_gym.agents.training.wrappers import TrainingReward
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.sb3 import make_vec_env


def main(seed: int = 0, steps: int = 10_000_000, out: Path = Path("runs/sb3-ppo.onnx")) -> Validation:
    """Train, write the agent file, and judge it on 100 validation crystals."""
    torch.set_num_threads(1)  # small networks are quicker so
    crystals = make_vec_env(512, stagger=seed, observation="history", action="smooth")
    env = VecNormalize(TrainingReward(crystals, gamma=0.99), norm_reward=False)
    settings: Any = {"n_steps": 64, "batch_size": 4096, "n_epochs": 5, "policy_kwargs": {"log_std_init": -0.7}}
    model = PPO("MlpPolicy", env, lambda left: 1e-3 * left, gamma=0.99, seed=seed, device="cpu", **settings)
    try:
        model.learn(steps, progress_bar=sys.stderr.isatty())
    except KeyboardInterrupt:
        print(f"interrupted after {model.num_timesteps:,} steps; what was learned goes into {out}", file=sys.stderr)
    save_agent(out, model, "sb3-ppo")
    return validate(load(out), crystals.env.config, VALIDATION_SEEDS[:100])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    for name, value in {"seed": 0, "steps": 10_000_000}.items():
        parser.add_argument(f"--{name}", type=int, default=value)
    found = main(**vars(parser.parse_args()))
    print(f"radius error {found.rmse_mm:.3f} mm, {100.0 * found.failure_rate:.0f} % of crystals lost")
