"""The facts of an agent's contract, for tests that write agents of their own."""

from typing import Any

from cz_gym.agents.agent_file.contract import facts_of
from cz_gym.config import make_config


def facts(observation: str = "history", **changes: Any) -> dict[str, Any]:
    """What :func:`cz_gym.agents.agent_file.contract.make_contract` asks for, of an agent trained on "randomized"."""
    config = make_config(observation=observation)
    known = {
        **facts_of(config),
        "algorithm": "ppo",
        "training_seed": 0,
        "training_steps": 64,
        "validation_cost": 0.1,
        "validation_rmse_mm": 1.0,
    }
    return {**known, **changes}
