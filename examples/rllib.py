"""RLlib's PPO on Cz-v0 as it stands, one environment after another and the native batch: ``python -m examples.rllib``.

Run by hand where ``ray[rllib]`` and torch are installed: they are too large for the test suite.
"""

from __future__ import annotations

import ray
from gymnasium import VectorizeMode
from ray.rllib.algorithms.ppo import PPOConfig

SETTINGS = {"control_interval": 60.0, "horizon": 3600.0}


def main() -> None:
    """Train for two iterations in each form; prints what RLlib counted."""
    ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False)
    for form in (VectorizeMode.SYNC, VectorizeMode.VECTOR_ENTRY_POINT):
        algorithm = (
            PPOConfig()
            .environment("cz_gym:Cz-v0", env_config=SETTINGS)
            .env_runners(num_env_runners=0, num_envs_per_env_runner=8, gym_env_vectorize_mode=form)
            .training(train_batch_size_per_learner=1200, minibatch_size=256, num_epochs=2)
            .build_algo()
        )
        for _ in range(2):
            result = algorithm.train()
            seen = result["env_runners"]
            print(
                f"{form.value}: {type(algorithm.env_runner.env.unwrapped).__name__}, iteration "
                f"{result['training_iteration']}, {seen['num_env_steps_sampled_lifetime']:.0f} steps, "
                f"{seen['num_episodes_lifetime']:.0f} episodes, mean return {seen['episode_return_mean']:.1f}",
                flush=True,
            )
        algorithm.stop()


if __name__ == "__main__":
    main()
