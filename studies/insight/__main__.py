"""What an agent does that other controllers do not: ``python -m studies.insight --out results/insight``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from cz_gym.agents import shipped
from cz_gym.agents.agent_file.contract import read_agent
from cz_gym.agents.policies.onnx import OnnxPolicy
from cz_gym.atomic_files import check_writable, write_files
from cz_gym.baselines import registry
from cz_gym.baselines.analysis import frequency
from cz_gym.baselines.analysis.linear_form import linear_form
from cz_gym.commands import OneLineParser, between
from cz_gym.config import make_config
from cz_gym.episodes.scenarios import PULLER, RANDOMIZED
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.evaluation.rollout import Course, rollout
from cz_gym.physics.linearisation import radius_model
from cz_gym.physics.plant import make_puller
from cz_gym.units import MINUTE

from .linear_agent import linear_agent, remembering_agent
from .loop import A_CRYSTAL, Contender, apart, margins, noise_gains, one_reading
from .step_tests import (
    LIMITS,
    MIX,
    STEP_TESTS,
    Interface,
    crystal,
    jump_gains,
    parts_of,
    respond,
    ripple_answers,
    run_events,
    survive,
    usual_noise,
)

AGENT = "gradient"
"""The shipped agent that is taken apart, unless a file is named."""
BESIDE = ("lqg-at-0.02", "lqg", "paper-tuned")
"""Controllers that an agent is shown beside."""
AT_REST = "at rest"
"""Behind an agent's name: linearised without noise."""


def contenders(path: Path | None) -> tuple[Contender, ...]:
    """The agent of a file, or the shipped one, and those it is shown beside.

    All are linearised under the usual noise, LQGs at the covariance that their filters settle on; the agent, last,
    also without any, where its network bends least.
    """
    file = path or shipped(AGENT)
    contract, content = read_agent(file)
    interface = Interface(contract.observation, contract.action)
    config = crystal(A_CRYSTAL / MINUTE, interface)
    policy = OnnxPolicy.load(file, config)

    def agent(label: str, course: Course) -> Contender:
        where = config.control_interval, contract.action, config.parameters.v_0
        if policy.remembers:
            system = remembering_agent(content, course.observation, course.memory, *where)
        else:
            system = linear_agent(content, course.observation, *where)
        return Contender(label, interface, lambda _: policy, system)

    return (
        agent(contract.algorithm, usual_noise(policy, interface)),
        *map(controller, BESIDE),
        agent(f"{contract.algorithm} {AT_REST}", run_events(policy, config, (), [0.0])),
    )


def controller(name: str) -> Contender:
    """A controller of the registry."""
    make = registry.find_controller(name).make
    return Contender(name, Interface(), make, linear_form(make(crystal(1.0, Interface()))).controller)


def puller_parts(contender: Contender, episodes: int) -> dict[str, dict[str, float]]:
    """Observable RMSE and share of lost crystals when randomized gets one property of puller, on validation."""
    found = {}
    policy = contender.make(make_config("randomized", **contender.interface._asdict()))
    for name, scenario in {"nothing": RANDOMIZED, **parts_of(PULLER, RANDOMIZED), "all of it": PULLER}.items():
        config = make_config(scenario, **contender.interface._asdict())
        values = metrics(rollout(policy, config, VALIDATION_SEEDS[:episodes]))
        found[name] = {
            "rmse_observable_mm": float(values.rmse_observable_mm.mean()),
            "failure_rate": float(values.failure_rate.mean()),
        }
    return found


def study(agent: Path | None, episodes: int, only_pictures: bool, tell: Callable[[str], None]) -> dict[str, bytes]:
    """Everything, as files by name."""
    from . import figures
    from .report import answer_figures, as_json, as_markdown, jump_figures, ripple_figures

    tell("linearising")
    all_of_them = contenders(agent)
    acting = [contender for contender in all_of_them if not contender.name.endswith(AT_REST)]
    made = {each.name: each.make(crystal(A_CRYSTAL / MINUTE, each.interface)) for each in acting}
    dt = crystal(1.0, Interface()).control_interval
    omega = frequency.frequencies(dt)
    tell("step tests")
    answers = {
        test.name: {each.name: respond(made[each.name], crystal(test.minutes, each.interface), test) for each in acting}
        for test in STEP_TESTS
    }
    jumps = {
        each.name: [jump_gains(made[each.name], each.interface, noisy) for noisy in (False, True)] for each in acting
    }
    ripples = {each.name: ripple_answers(made[each.name], each.interface) for each in acting}
    responses = {each.name: each.loop(omega, MIX, dt) for each in all_of_them}
    files = {
        "responses.png": figures.response_figure(answers, dt),
        "gains.png": figures.gain_figure({each.name: one_reading(each, dt) for each in all_of_them}, responses, dt),
        "loop.png": figures.loop_figure(responses, radius_model(make_puller(lam=MIX)).zero),
        "jumps.png": figures.jump_figure(jumps),
        "ripple.png": figures.ripple_figure(ripples),
        "shares.png": figures.share_figure(answers["load"], responses, STEP_TESTS[1].title),
    }
    if only_pictures:
        return files
    limits: dict[str, Any] = {}
    parts: dict[str, Any] = {"validation_episodes": episodes}
    for each in acting:
        tell(f"limits of {each.name}")
        survived = {limit.name: survive(made[each.name], limit, each.interface) for limit in LIMITS}
        limits[each.name] = {name: one._asdict() for name, one in survived.items()}
        tell(f"{each.name}, one property of the real puller at a time")
        parts[each.name] = puller_parts(each, episodes)
    beside = next(each for each in all_of_them if each.name == BESIDE[0])
    found = {
        "agent": asdict(read_agent(agent or shipped(AGENT))[0]),
        "answers": {test: {name: answer_figures(one) for name, one in by.items()} for test, by in answers.items()},
        "margins": [row for each in all_of_them for row in margins(each, omega, dt)],
        "noise_gain": {each.name: noise_gains(each, dt) for each in all_of_them},
        "apart": {"from": beside.name} | {o.name: apart(o, beside, dt) for o in all_of_them if o is not beside},
        "jumps": jump_figures(jumps),
        "ripples": ripple_figures(ripples),
        "limits": limits,
        "puller_parts": parts,
    }
    return {**files, "insight.json": as_json(found).encode(), "insight.md": as_markdown(found).encode()}


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser("python -m studies.insight", (__doc__ or "").split("\n")[0])
    parser.add_argument("--agent", type=Path, metavar="FILE", help="agent file in place of the shipped one")
    most, about = len(VALIDATION_SEEDS), "validation episodes (%(default)s)"
    parser.add_argument("--episodes", type=between(1, most), default=50, metavar="N", help=about)
    parser.add_argument("--pictures", action="store_true", help="draw the pictures alone; the tables stay as they are")
    parser.add_argument("--out", type=Path, default=Path("results/insight"), metavar="DIR", help="%(default)s")
    return parser.run(_main, arguments, "benchmark")


def _main(given: argparse.Namespace) -> None:
    check_writable(given.out)
    files = study(given.agent, given.episodes, given.pictures, lambda what: print(what, file=sys.stderr, flush=True))
    write_files({given.out / name: content for name, content in files.items()})
    print(files.get("insight.md", b"").decode() or f"wrote {', '.join(files)}\n", end="")


if __name__ == "__main__":
    sys.exit(main())
