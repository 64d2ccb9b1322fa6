"""One hash of an environment's results; ``python -m tests.golden.digest`` prints it, and the file of cz_gym."""

import hashlib

import numpy as np

import cz_gym
from cz_gym import CzVectorEnv


def digest() -> str:
    """SHA-256 of everything that three scenarios return under random actions."""
    found = hashlib.sha256()
    for scenario in ("randomized", "puller", "sensor-fault"):
        env = CzVectorEnv(
            3, scenario, observation="history", control_interval=20.0, horizon=600.0, info="all", action="direct"
        )
        observation, infos = env.reset(seed=[4, 5, 6])
        rng = np.random.default_rng(0)
        for _ in range(70):
            found.update(observation.tobytes() + b"".join(np.asarray(infos[name]).tobytes() for name in sorted(infos)))
            observation, reward, terminated, truncated, infos = env.step(rng.uniform(-0.5, 0.5, (3, 2)))
            found.update(reward.tobytes() + terminated.tobytes() + truncated.tobytes())
    return found.hexdigest()


if __name__ == "__main__":
    print(digest(), cz_gym.__file__)
