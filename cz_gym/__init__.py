"""Cz-v0: Czochralski crystal growth as a Gymnasium environment.

Importing this package registers ``Cz-v0`` and ``CzCrystal-v0``; ``gym.make("cz_gym:Cz-v0")`` imports it by itself.
"""

import sys
from importlib import import_module
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_file_location
from pathlib import Path
from types import SimpleNamespace
from typing import Any

try:
    import gymnasium as gym
except ModuleNotFoundError as error:
    said = f"{error.name} is missing: run .venv/bin/python, which `make venv` makes, or `pip install .`"
    if sys.argv[0] == "-m":  # a command, as cz-gym play
        sys.exit(said)
    raise ModuleNotFoundError(said, name=error.name) from None

from cz_gym.episodes.scenario import Scenario
from cz_gym.episodes.scenarios import SCENARIOS
from cz_gym.physics.meniscus import HURLE, MeniscusModel
from cz_gym.physics.parameters import Parameters
from cz_gym.physics.plant import Puller, State, make_puller

from .config import Config
from .env import CzEnv, CzVectorEnv, EnvState
from .spaces import decode
from .vector_checker import check_vector_env


def _beside(name: str, *_: object) -> ModuleSpec | None:
    """Find ``cz_gym.agents``, ``baselines`` and ``examples`` in a clone, where they stand beside this folder."""
    package, own = name.partition(".")[::2]
    place = Path(__file__).parents[1] / own
    if package != __name__ or own not in ("agents", "baselines", "examples") or not place.is_dir():
        return None
    return spec_from_file_location(name, place / "__init__.py", submodule_search_locations=[str(place)])


sys.meta_path.append(SimpleNamespace(find_spec=_beside))

__version__ = "0.2.0"
ENV_ID = "Cz-v0"

__all__ = [
    "ENV_ID",
    "HURLE",
    "SCENARIOS",
    "Config",
    "CzEnv",
    "CzVectorEnv",
    "EnvState",
    "MeniscusModel",
    "Parameters",
    "Puller",
    "Scenario",
    "State",
    "check_vector_env",
    "decode",
    "make_puller",
]

gym.register(id=ENV_ID, entry_point="cz_gym.env:CzEnv", vector_entry_point="cz_gym.env:CzVectorEnv")
gym.register(
    id="CzCrystal-v0",
    entry_point="cz_gym.env:CzCrystalEnv",
    vector_entry_point="cz_gym.env:CzCrystalVectorEnv",
)


def __getattr__(name: str) -> Any:
    # After "import cz_gym", cz_gym.agents.load("ppo") works: what stands above this package is imported when asked for.
    if name in ("agents", "baselines", "evaluation"):
        return import_module(f"cz_gym.{name}")
    raise AttributeError(f"module 'cz_gym' has no attribute {name!r}")
