"""Learned controllers: training with stable-baselines3, and running what was trained without it.

``load("gradient")`` is a trained agent, ready to act. Importing this package needs neither torch nor
stable-baselines3; training (:mod:`cz_gym.agents.training.learners`) needs both.
"""

from __future__ import annotations

if __name__ != "cz_gym.agents":
    raise ImportError("import cz_gym.agents: the folder agents is that package, under no other name")

from pathlib import Path

from cz_gym.agents.agent_file.contract import AgentFileError, Contract, read_agent
from cz_gym.agents.policies.onnx import OnnxPolicy
from cz_gym.config import Config
from cz_gym.names import unknown

__all__ = ["AgentFileError", "Contract", "OnnxPolicy", "load", "shipped", "shipped_names", "shipped_seeds"]

MODELS = Path(__file__).parent / "models"
DEFAULT = "gradient"


def load(name: str | Path = DEFAULT, config: Config | None = None) -> OnnxPolicy:
    """A trained agent, ready for ``predict``: the shipped one of that name, or that of an agent file (.onnx).

    With a config, it must have been trained on the same nominal plant, and for its observation, actions and control
    interval; without, ``gym.make("Cz-v0", **agent.settings)`` makes an environment for it. AgentFileError says in one
    line why an agent cannot be had, or names what there is.
    """
    policy = OnnxPolicy.load(name if Path(name).suffix == ".onnx" else shipped(str(name)), config)
    for setting, value in policy.settings.items():
        if config is not None and getattr(config, setting) != value:
            raise AgentFileError(
                f"{name} is made for {setting}={value!r}, this config has {getattr(config, setting)!r}: "
                f"make_config(..., {setting}={value!r}) fits"
            )
    return policy


def shipped_names() -> list[str]:
    """Names of the trained agents that come with the package."""
    return sorted({path.stem.rpartition("-seed")[0] for path in MODELS.glob("*-seed*.onnx")})


def shipped_seeds(name: str = DEFAULT) -> list[Path]:
    """Paths of the trained agents of that name that come with the package, one a training seed, in their order.

    AgentFileError names what there is.
    """
    found = {int(path.stem.removeprefix(f"{name}-seed")): path for path in MODELS.glob(f"{name}-seed[0-9]*.onnx")}
    if not found:
        raise AgentFileError(unknown("shipped agent", name, shipped_names()))
    return [found[seed] for seed in sorted(found)]


def shipped(name: str = DEFAULT) -> Path:
    """Path of the one of :func:`shipped_seeds` of least cost on validation episodes that picked nothing before."""
    return min(shipped_seeds(name), key=lambda path: read_agent(path)[0].validation_cost)
