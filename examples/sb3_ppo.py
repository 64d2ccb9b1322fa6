"""Train PPO of stable-baselines3 on Cz-v0, from nothing, by reward: ``python -m examples.sb3_ppo``, about 4 minutes.

Then judge it on validation crystals, and write it as an agent file, which ``benchmark.py --agent`` runs.
"""

from __future__ import annotations

import sys
from pathlib import Path

from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

from cz_gym import CzVectorEnv
from cz_gym.agents.from_sb3 import save_agent
from cz_gym.agents.training.vec_env import CzVecEnv


def main(steps: int = 4_000_000, seed: int = 0, out: Path = Path("runs/sb3-ppo.onnx")) -> float:
    """Train, write the agent file, and return its mean radius error on 200 validation crystals [mm]."""
    pullers = CzVectorEnv(256, observation="history", action="smooth", autoreset_mode="SameStep")
    env = VecNormalize(CzVecEnv(pullers, stagger=seed), gamma=0.99)
    model = PPO(
        "MlpPolicy",
        env,
        n_steps=64,
        batch_size=2048,
        n_epochs=5,
        learning_rate=lambda left: 1e-3 * left,
        policy_kwargs={"log_std_init": -0.7},
        seed=seed,
        device="cpu",
    )
    model.learn(steps, progress_bar=sys.stderr.isatty())
    return save_agent(out, model, "sb3-ppo").validation_rmse_mm


if __name__ == "__main__":
    print(f"mean radius error {main():.3f} mm")
