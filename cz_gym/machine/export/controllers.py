"""A controller or an agent by its name in the shell that a plant needs: for exports, and for the virtual puller."""

import pkgutil
import re
from pathlib import Path
from typing import Any

from cz_gym.config import Config
from cz_gym.errors import CzError
from cz_gym.support.names import unknown

from .agent import Agent
from .shell import Block

REGISTRY, AGENTS = "cz_gym.baselines.registry", "cz_gym.agents"
"""Modules that know controllers and agents, looked up by name because this package imports neither."""
FALLBACK = "paper-tuned"
"""The PID that takes over."""


def make_block(name: str, config: Config) -> Block:
    """A controller or agent in its shell; its fallback is the re-tuned PID of the same settings.

    CzError if there is none of that name, if it cannot be exported, or if an agent is of another puller.
    """
    agents: Any = pkgutil.resolve_name(AGENTS)
    known = [entry.name for entry in pkgutil.resolve_name(f"{REGISTRY}:CONTROLLERS") if not entry.bound]
    plant = f"Puller {config.puller.label}; plant {config.plant_hash}; control interval {config.control_interval:g} s."
    pid = pkgutil.resolve_name(f"{REGISTRY}:make_controller")(FALLBACK, config)
    identifier = re.sub(r"\W+", "_", Path(name.removesuffix(".onnx")).name.lower())
    if name in known:
        entry = pkgutil.resolve_name(f"{REGISTRY}:find_controller")(name)
        tuned = f"Settings tuned for scenario {config.scenario.name} ({config.scenario.hash}). {plant}"
        controller = entry.make(config)
        if not (hasattr(controller, "at_rest") and hasattr(controller, "step")):
            raise CzError(f"{name} cannot be exported: it solves an optimisation problem, or has no feedback")
        return Block(identifier, controller, pid, config, (f"Controller {name}: {entry.meaning}.", tuned))
    if name not in agents.shipped_names() and Path(name).suffix != ".onnx":
        raise CzError(unknown("controller or agent", name, [*known, *agents.shipped_names()]))
    contract = (policy := agents.load(name)).contract
    its, own = (
        f"puller {each.puller}, plant {each.plant}, control interval {each.control_interval:g} s"
        for each in (policy.made_for, config.made_for)
    )
    if its != own:
        raise CzError(f"{name} was trained for {its}, not for {own}")
    facts = (
        f"Agent {name}: {contract.algorithm}, seed {contract.training_seed}, trained on {contract.scenario} "
        f"({contract.scenario_hash}).",
        f"File {contract.sha256}; observation {contract.observation} {contract.observation_hash}. {plant}",
    )
    return Block(identifier, Agent(policy, config), pid, config, facts)
