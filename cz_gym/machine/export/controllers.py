"""A controller or an agent by its name in the shell that a plant needs: for exports, and for the virtual puller."""

import pkgutil
import re
import unicodedata
from pathlib import Path
from typing import Any

from cz_gym.config import Config
from cz_gym.errors import CzError
from cz_gym.machine.puller import DEFAULT
from cz_gym.support.names import unknown

from .agent import Agent
from .shell import Block

REGISTRY, AGENTS, SEARCH = "cz_gym.baselines.registry", "cz_gym.agents", "cz_gym.baselines.fallback:fallback"
"""Modules that know controllers and agents, and the search for the PID that takes over, looked up by name because this
package imports neither."""
FALLBACK = "fallback"
"""Name of the PID that takes over, as a controller of its own."""


def make_block(name: str, config: Config) -> Block:
    """A controller or agent in its shell; its fallback is a PID searched for the puller.

    CzError if there is none of that name, if it cannot be exported, or if an agent is of another puller.
    """
    agents: Any = pkgutil.resolve_name(AGENTS)
    known = [entry.name for entry in pkgutil.resolve_name(f"{REGISTRY}:CONTROLLERS") if not entry.bound]
    plant = f"Puller {config.puller.label}; plant {config.plant_hash}; control interval {config.control_interval:g} s."
    if name not in (*known, FALLBACK, *agents.shipped_names()) and Path(name).suffix != ".onnx":
        raise CzError(unknown("controller or agent", name, [*known, FALLBACK, *agents.shipped_names()]))
    pid, *margins = pkgutil.resolve_name(SEARCH)(config)
    fallback = (
        f"Fallback: PID searched for this puller with the drives and the camera of scenario {config.scenario.name}: "
        "gain margin {:.3g}, phase margin {:.3g} deg on Models I and II with a latency of {:g} s.".format(*margins)
    )
    identifier = identifier_of(Path(name.removesuffix(".onnx")).name)
    if name == FALLBACK:
        return Block(identifier, pid, pid, config, (fallback, plant))
    if name in known:
        entry = pkgutil.resolve_name(f"{REGISTRY}:find_controller")(name)
        tuned = f"Settings of scenario {config.scenario.name} ({config.scenario.hash})"
        if config.puller != DEFAULT:
            tuned = "Settings scaled to the puller, or searched for it beside its file"
        controller = entry.make(config)
        if not getattr(controller, "exportable", False):
            raise CzError(f"{name} cannot be exported: it has no feedback, several filters or an optimisation")
        facts = f"Controller {name}: {entry.meaning}.", f"{tuned}.", plant, fallback
        return Block(identifier, controller, pid, config, facts)
    contract = (policy := agents.load(name)).contract
    its, own = (
        f"puller {each.puller}, plant {each.plant}, control interval {each.control_interval:g} s"
        for each in (policy.made_for, config.made_for)
    )
    if its != own:
        raise CzError(f"{name} was trained for {its}, not for {own}")
    trained = f"trained on {contract.scenario} ({contract.scenario_hash})"
    about = f"Agent {name}: {contract.algorithm}, seed {contract.training_seed}, {trained}."
    file = f"File {contract.sha256}; observation {contract.observation} {contract.observation_hash}."
    return Block(identifier, Agent(policy, config), pid, config, (about, file, plant, fallback))


def identifier_of(name: str) -> str:
    """A name as a part of identifiers: a letter or digit at both ends, no two underscores in a row, ASCII."""
    plain = unicodedata.normalize("NFKD", name.lower()).encode("ascii", "ignore").decode()
    return re.sub(r"[^a-z0-9]+", "_", plain).strip("_") or "agent"
