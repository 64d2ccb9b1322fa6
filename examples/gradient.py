"""Train analytic policy gradients on Cz-v0, from nothing: ``python -m cz_gym.examples.gradient``, four minutes.

The gradient of the cost goes back through the plant. ``cz-gym benchmark --agent runs/gradient.onnx`` runs the agent.
"""

import sys
from pathlib import Path

try:
    import torch

    from cz_gym.agents.apg import APG
except ModuleNotFoundError as error:
    sys.exit(f'{error.name} is missing: make venv, then .venv/bin/python, or pip install ".[agents]"')

from cz_gym.agents.contract import Contract
from cz_gym.agents.from_sb3 import save_agent
from cz_gym.sb3 import make_vec_env


def main(steps: int = 6_912_000, num_envs: int = 192, out: Path = Path("runs/gradient.onnx")) -> Contract:
    """Train on every scenario, write the agent file, and judge it on 200 validation crystals."""
    torch.set_num_threads(1)  # small networks are quicker so
    env = make_vec_env(num_envs, scenario="all", observation="measured", action="rate")
    model = APG("RecurrentPolicy", env, seed=0)
    model.learn(steps, progress_bar=sys.stderr.isatty())
    return save_agent(out, model, "gradient")


if __name__ == "__main__":
    print(f"radius error {main().validation_rmse_mm:.3f} mm on validation crystals")
