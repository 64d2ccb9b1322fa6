"""``cz-gym check FILE``: check that an agent or a controller fits an environment, before a run."""

import argparse
import pickle
import time
import tracemalloc
from collections.abc import Sequence
from typing import Any

import numpy as np

from cz_gym.agents import OnnxPolicy
from cz_gym.agents.contract import Contract
from cz_gym.config import Config, make_config
from cz_gym.crystal.process import ENVIRONMENTS
from cz_gym.env import CzVectorEnv
from cz_gym.evaluation.protocol import GROUPS, scenarios, user_controller
from cz_gym.evaluation.rollout import call_policy, check_policy, informed, settings_of
from cz_gym.puller.file import chosen_puller
from cz_gym.support.command_line import OneLineParser, filled
from cz_gym.support.errors import CzError
from cz_gym.support.units import MICRO

CRYSTALS, STEPS = 16, 60
"""Crystals at once, and steps."""
SEEDS = range(900_000, 900_000 + CRYSTALS)
"""Training seeds of these crystals."""
ALIKE = 1e-4
"""Largest difference between an action in a batch and the same one alone [action units]."""
SLOW = 0.1
"""Share of the control interval above which a step for one crystal is slow [-]."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Check a file and print what was found; 0 if it fits, 2 with the reason if it does not."""
    about = "Check an agent file, or a controller, before a run: contract, shapes, memory, speed."
    parser = OneLineParser("cz-gym check", about)
    add = parser.add_argument
    add("policy", metavar="FILE", help="agent file (.onnx), or FILE.py:NAME")
    add("--env", choices=ENVIRONMENTS, default="Cz-v0", help="environment of a controller (%(default)s)")
    parser.add_scenario("scenario of the crystals (%(default)s)", "randomized")
    parser.add_puller("check it there")
    return parser.run(_main, arguments, "benchmark", "nothing written")


def _main(given: argparse.Namespace) -> None:
    policy, config = _loaded(given)
    settings = settings_of(policy)
    rows = [("environment", f"{config.process.name}, puller {config.puller.label}, plant {config.plant_hash}")]
    rows += [(name, f"{settings.get(name, getattr(config, name))}") for name in ("observation", "action")]
    rows += [("interval", f"{config.control_interval:g} s")]
    if isinstance(policy, OnnxPolicy):
        rows += _declared(policy.contract)
    check_policy(policy, config)
    rows += list(check_calls(policy, config))
    for name, text in rows:
        print(filled(text, f"{name:<13} ", " " * 14))
    print("fits: it may run in the benchmark")


def _loaded(given: argparse.Namespace) -> tuple[Any, Config]:
    """The policy of a file, and the environment that it asks for, on the scenario and puller of the command line."""
    scenario, puller = scenarios(given.scenario), chosen_puller(given.puller)
    if given.policy.endswith(".onnx"):
        contract = (agent := OnnxPolicy.load(given.policy)).contract
        config = make_config(scenario, puller=puller, process=ENVIRONMENTS[contract.environment], **agent.settings)
        return OnnxPolicy.load(given.policy, config), config
    if ":" not in given.policy:
        raise CzError(f"{given.policy}: must be an agent file (.onnx) or FILE.py:NAME")
    process = ENVIRONMENTS[given.env]
    usual = make_config(scenario, None, "measured", action="direct", puller=puller, process=process)
    contender = user_controller(given.policy, usual)
    modes: dict[str, Any] = {"observation": contender.observation, "action": contender.action}
    config = make_config(scenario, puller=puller, process=process, **modes)
    return contender.make(config), config


def _declared(contract: Contract) -> list[tuple[str, str]]:
    """Facts of a contract that are taken from it, not measured."""
    told = f"{contract.training_steps:,} steps, seed {contract.training_seed}, {GROUPS[contract.learned_from]}"
    cost = f"RMSE {contract.validation_rmse_mm:.3f} mm, cost {contract.validation_cost:.4g} on its maker's validation"
    return [
        ("agent", f"{contract.algorithm}, hash {contract.hash[:12]}"),
        ("declared", f"{told}, on {contract.scenario}; {cost}"),
    ]


def check_calls(policy: Any, config: Config) -> list[tuple[str, str]]:
    """Run a policy for some steps, in a batch and alone; CzError where shapes, memory or actions are not as agreed."""
    policy = informed(policy, config, SEEDS)
    alone, largest, took = _Alone(), 0.0, list[float]()
    state: Any = None
    begins = np.ones(CRYSTALS, np.bool_)
    env = CzVectorEnv.from_config(config, CRYSTALS)
    observation, _ = env.reset(seed=list(SEEDS))
    tracemalloc.start()
    for step in range(STEPS):
        before = observation.copy()
        action, state = call_policy(policy, observation, state, begins)
        array = np.asarray(action)
        if array.dtype.kind not in "fiu" or not np.isfinite(array).all():
            raise CzError(f"step {step}: its actions are not finite numbers: {array[:3].tolist()}")
        if not np.array_equal(observation, before, equal_nan=observation.dtype.kind == "f"):
            raise CzError(f"step {step}: it writes into the observations that it is given")
        one, seconds = alone.act(policy, observation[:1], begins[:1])
        took.append(seconds)
        largest = max(largest, float(np.abs(one[0] - array[0]).max()))
        observation, _, terminated, truncated, _ = env.step(array)
        begins = terminated | truncated
    memory, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    env.close()
    if largest > ALIKE:
        raise CzError(f"its action depends on the batch: that of a crystal alone differs by {largest:.2g}")
    _check_beginning(policy, observation, state)
    typical = float(np.median(took))
    share = typical / config.control_interval
    pace = "slow: it may be late on a plant" if share > SLOW else f"{share:.2g} of the control interval"
    held = len(pickle.dumps(state)) if state is not None else 0
    return [
        ("shapes", f"{observation.shape[1:]} to (2,), alone and in a batch of {CRYSTALS}"),
        ("state", f"{held / CRYSTALS:.0f} bytes a crystal" if held else "none"),
        ("memory", f"{peak / 1e6:.1f} MB while it ran, {memory / 1e6:.1f} MB kept"),
        ("speed", f"{typical / MICRO:.0f} us a step for one crystal, {pace}"),
    ]


class _Alone:
    """The first crystal of a batch, run alone."""

    state: Any = None

    def act(self, policy: Any, observation: Any, begins: Any) -> tuple[Any, float]:
        """Return the action and the time that it took [s]."""
        before = time.perf_counter()
        action, self.state = call_policy(policy, observation, self.state, begins)
        return np.asarray(action), time.perf_counter() - before


def _check_beginning(policy: Any, observation: Any, state: Any) -> None:
    """Raise CzError for a policy whose memory outlives a crystal."""
    ends = np.ones(len(observation), np.bool_)
    again, _ = call_policy(policy, observation, state, ends)
    fresh, _ = call_policy(policy, observation, None, ends)
    apart = float(np.abs(np.asarray(again) - np.asarray(fresh)).max())
    if apart > ALIKE:
        raise CzError(f"its memory does not begin anew where episode_start is true: actions differ by {apart:.2g}")
