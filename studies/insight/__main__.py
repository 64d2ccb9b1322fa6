"""How an agent reacts to single events, beside classical controllers: ``python -m studies.insight``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from cz_gym.agents import shipped
from cz_gym.agents.agent_file.contract import read_agent
from cz_gym.agents.policies.onnx import OnnxPolicy
from cz_gym.atomic_files import check_writable, write_files
from cz_gym.baselines.analysis.linear_form import linear_form
from cz_gym.baselines.registry import make_controller
from cz_gym.commands import OneLineParser, between
from cz_gym.config import make_config
from cz_gym.episodes.scenarios import PULLER, RANDOMIZED
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.evaluation.rollout import rollout
from cz_gym.physics.linearisation import StateSpace

from .linear_agent import linear_agent
from .step_tests import (
    LIMITS,
    STEP_TESTS,
    Interface,
    crystal,
    jump_gains,
    parts_of,
    respond,
    ripple_gains,
    run_events,
    survive,
    usual_noise,
)

AGENT = "gradient"
"""The shipped agent that is examined, unless a file is named."""
BESIDE = ("lqg-at-0.02", "lqg", "paper-tuned")
"""Controllers that the agent is shown beside."""


class Contender(NamedTuple):
    """A policy, and its linear systems near rest from the channels of MEASURED to v_p [m/s] and Q_H [W]."""

    name: str
    policy: Any
    interface: Interface
    systems: dict[str, StateSpace]
    """By what is added to the name in tables: "" under the usual noise, " at rest" without noise."""


def learned(path: Path) -> Contender:
    """The agent of a file, linearised under the usual noise and without noise, where its gains are highest."""
    contract, content = read_agent(path)
    interface = Interface(contract.observation, contract.action)
    config = crystal(180.0, interface)
    policy = OnnxPolicy.load(path, config)
    courses = {
        "": usual_noise(policy, interface),
        " at rest": run_events(policy, config, (), [0.0]),
    }
    where = config.control_interval, contract.action, config.parameters.v_0
    systems = {
        name: linear_agent(content, course.observation, course.memory, *where) for name, course in courses.items()
    }
    return Contender(contract.algorithm, policy, interface, systems)


def classical(name: str) -> Contender:
    """A shipped controller; an LQG is linearised at the covariance that its filter settles on."""
    policy = make_controller(name, crystal(180.0, Interface()))
    return Contender(name, policy, Interface(), {"": linear_form(policy).controller})


def puller_parts(contender: Contender, episodes: int) -> dict[str, tuple[float, float]]:
    """Observable RMSE [mm] and share of lost crystals when randomized gets one property of puller, on validation."""
    found = {}
    for name, scenario in {"nothing": RANDOMIZED, **parts_of(PULLER, RANDOMIZED), "all of it": PULLER}.items():
        config = make_config(scenario, **contender.interface._asdict())
        values = metrics(rollout(contender.policy, config, VALIDATION_SEEDS[:episodes]))
        found[name] = float(values.rmse_observable_mm.mean()), float(values.failure_rate.mean())
    return found


def study(agent: Path, episodes: int) -> dict[str, bytes]:
    """Every experiment; figures and tables by file name."""
    from . import figures, report

    all_of_them = (learned(agent), *map(classical, BESIDE))
    _say("step tests")
    answers = {
        test: {each.name: respond(each.policy, crystal(test.minutes, each.interface), test) for each in all_of_them}
        for test in STEP_TESTS
    }
    jumps = {
        each.name: {noise: jump_gains(each.policy, each.interface, noise == "usual") for noise in ("none", "usual")}
        for each in all_of_them
    }
    ripples = {each.name: ripple_gains(each.policy, each.interface) for each in all_of_them}
    systems = {each.name + how: system for each in all_of_them for how, system in each.systems.items()}
    limits, parts = {}, {}
    for each in all_of_them:
        _say(f"limits of {each.name}")
        limits[each.name] = [survive(each.policy, limit, each.interface) for limit in LIMITS]
        parts[each.name] = puller_parts(each, episodes)
    contract, _ = read_agent(agent)
    sections = {
        "Answers to single events": report.answers(answers),
        "How strongly a jump of the radius is answered [mm/min per mm]": report.jumps(jumps),
        "How strongly a ripple of 0.1 mm is answered [mm/min per mm]": report.ripples(ripples),
        "Margins of the loop": report.margins(systems),
        "Largest event survived, median and range over draws of noise": report.limits(limits),
        f"One property of the real puller at a time ({episodes} validation crystals)": report.parts(parts),
    }
    title = f"# What the agent does (seed {contract.training_seed} of `{contract.algorithm}`)"
    text = "\n\n".join([title, *(f"## {head}\n\n{table}" for head, table in sections.items())]) + "\n"
    return {
        "responses.png": figures.response_figure(answers),
        "jumps.png": figures.jump_figure(jumps),
        "ripple.png": figures.ripple_figure(ripples),
        "insight.md": text.encode(),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser("python -m studies.insight", (__doc__ or "").split("\n")[0])
    parser.add_argument("--agent", type=Path, metavar="FILE", help="agent file in place of the shipped one")
    most, about = len(VALIDATION_SEEDS), "validation episodes (%(default)s)"
    parser.add_argument("--episodes", type=between(1, most), default=50, metavar="N", help=about)
    parser.add_argument("--out", type=Path, default=Path("results/insight"), metavar="DIR", help="%(default)s")
    return parser.run(_main, arguments, "benchmark")


def _main(given: argparse.Namespace) -> None:
    check_writable(given.out)
    files = study(given.agent or shipped(AGENT), given.episodes)
    write_files({given.out / name: content for name, content in files.items()})
    print(files["insight.md"].decode(), end="")


def _say(what: str) -> None:
    print(what, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
