"""TorchRL on Cz-v0 as it stands: ``python -m examples.torchrl``.

It needs more than ``make venv`` installs: ``pip install torchrl``.
"""

from __future__ import annotations

import argparse
import sys

try:
    import torch
    import torchrl
    from tensordict.nn import TensorDictModule
    from torchrl.collectors import Collector
    from torchrl.envs import GymEnv, check_env_specs
except ModuleNotFoundError as error:
    sys.exit(f"{error.name} is missing: .venv/bin/python -m pip install torchrl torch")

import cz_gym  # noqa: F401


def main() -> None:
    """Check the specs, then gather frames with a linear policy; prints how many."""
    env = GymEnv("Cz-v0", control_interval=20.0, horizon=400.0)
    check_env_specs(env)
    policy = TensorDictModule(torch.nn.Linear(72, 2), in_keys=["observation"], out_keys=["action"])
    frames, ended = 0, 0
    for batch in Collector(env, policy, frames_per_batch=64, total_frames=256):
        frames, ended = frames + batch.numel(), ended + int(batch["next", "done"].sum())
        if not batch["next", "reward"].isfinite().all():
            raise ValueError("a reward is not finite")
    print(f"torchrl {torchrl.__version__}, torch {torch.__version__}: {frames} frames, {ended} episodes ended")


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    main()
