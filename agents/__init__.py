"""Learned controllers: trained with stable-baselines3 or by exact gradients, run by onnxruntime alone.

``load("gradient")`` is a trained agent, ready to act. Importing this package needs neither torch nor
stable-baselines3; training (:mod:`cz_gym.agents.apg`, ``train.py``) needs both.
"""

if __name__ != "cz_gym.agents":
    raise ImportError("import cz_gym.agents: the folder agents is that package, under no other name")

from pathlib import Path
from typing import Any

from cz_gym.config import Config
from cz_gym.crystal.process import ENVIRONMENTS
from cz_gym.support.errors import unknown_name_message

from .contract import AgentFileError, Contract, OnnxPolicy, read_agent

__all__ = [
    "AgentFileError",
    "Contract",
    "OnnxPolicy",
    "load",
    "save_agent",
    "shipped",
    "shipped_names",
    "shipped_seeds",
]

MODELS = Path(__file__).parent / "models"
DEFAULT = "gradient"


def load(name: str | Path = DEFAULT, config: Config | None = None) -> OnnxPolicy:
    """Load a trained agent, ready for ``predict``: a shipped one by its name, or an agent file (.onnx).

    With a config, the agent must be made for its plant, observation, actions and control interval; without,
    ``gym.make(agent.contract.environment, **agent.settings)`` makes an environment for the agent. AgentFileError says
    in one line why the agent cannot be loaded.
    """
    policy = OnnxPolicy.load(name if Path(name).suffix == ".onnx" else shipped(str(name)), config)
    for setting, value in policy.settings.items():
        if config is not None and getattr(config, setting) != value:
            raise AgentFileError(
                f"{name} is made for {setting}={value!r}, this config has {getattr(config, setting)!r}: "
                f"make_config(..., {setting}={value!r}) fits"
            )
    return policy


def __getattr__(name: str) -> Any:
    if name == "save_agent":  # it needs torch
        from .from_torch import save_agent

        return save_agent
    raise AttributeError(f"module 'cz_gym.agents' has no attribute {name!r}")


def shipped_names(environment: str = "Cz-v0") -> list[str]:
    """Names of the trained agents that come with the package for an environment."""
    names = sorted({path.stem.rpartition("-seed")[0] for path in MODELS.glob("*-seed*.onnx")})
    return [name for name in names if read_agent(shipped_seeds(name)[0])[0].environment == environment]


def shipped_seeds(name: str = DEFAULT) -> list[Path]:
    """Paths of the shipped agents of that name, by training seed; AgentFileError lists the names there are."""
    paths = {int(path.stem.removeprefix(f"{name}-seed")): path for path in MODELS.glob(f"{name}-seed[0-9]*.onnx")}
    if not paths:
        known = [each for environment in ENVIRONMENTS for each in shipped_names(environment)]
        raise AgentFileError(unknown_name_message("shipped agent", name, known))
    return [paths[seed] for seed in sorted(paths)]


def shipped(name: str = DEFAULT) -> Path:
    """Path of the shipped agent of that name with the least validation cost."""
    return min(shipped_seeds(name), key=lambda path: read_agent(path)[0].validation_cost)
