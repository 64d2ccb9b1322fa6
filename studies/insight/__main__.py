"""What an agent does that other controllers do not: ``python -m studies.insight --out results/insight``.

Answers to single events on a nominal puller, the network's exact local gain and the margins of its loop beside the
LQG's, how large an event each survives, and which property of the real puller costs it crystals.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cz_gym.agents import shipped
from cz_gym.agents.agent_file.contract import read_agent
from cz_gym.agents.policies.onnx import OnnxPolicy
from cz_gym.atomic_files import check_writable, write_files
from cz_gym.baselines import registry
from cz_gym.baselines.analysis import frequency, sampled_loop
from cz_gym.baselines.analysis.linear_form import linear_form
from cz_gym.commands import OneLineParser, guarded
from cz_gym.config import make_config
from cz_gym.episodes.scenarios import PULLER, RANDOMIZED
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.evaluation.rollout import rollout
from cz_gym.observation import MEASURED
from cz_gym.physics.linearisation import radius_model
from cz_gym.physics.plant import make_puller
from cz_gym.units import HOUR, KILO, MINUTE, MM, MM_PER_MIN

from .linear_agent import SEEN, Floats, linear_agent
from .loop import Responses, after_one, response
from .report import BANDS
from .step_tests import (
    AT_REST,
    JUMPS,
    LIMITS,
    MIX,
    TRIALS,
    crystal,
    jump_gains,
    noisy_observations,
    parts_of,
    respond,
    run_events,
    survive,
)

PROG = "python -m studies.insight"
BESIDE = ("lqg-at-0.02", "lqg", "paper-tuned")
"""Controllers that an agent is shown beside; its teacher is among them."""
A_CRYSTAL = 3.0 * HOUR
"""How long a crystal is grown [s]."""
READINGS = tuple(channel.name for channel in MEASURED)
MODELS = (("Model I", 1.0), ("Model II", 0.0))
Answers = dict[str, dict[str, Any]]
"""Signals by trial, then by controller."""
Jumps = dict[str, tuple[Any, ...]]
"""Answers to jumps by controller, without noise and under it."""
READING_SAMPLES = 120
"""Length of the answer to one reading."""
NOISE_POINTS = 20_000
"""Frequencies that a variance is summed over."""


class Contender(NamedTuple):
    """A controller as everything here needs it."""

    name: str
    observation: str
    make: Callable[[Any], Any]
    """Builds it for an environment's settings."""
    system: Any
    """Its state space near rest: readings of MEASURED to v_p [m/s] and Q_H [W]."""
    answer: Callable[[Floats], Any]
    """Its frequency response, drives by the readings of SEEN."""


class Margins(NamedTuple):
    """A row of the table of margins."""

    controller: str
    plant: str
    at: str
    """Where the loop is opened."""
    growth: float
    """Time in which what grows fastest in the closed loop grows by e [s]; infinite if nothing does."""
    crossover: float
    """[rad/s]"""
    gain_up: float
    gain_down: float
    phase_deg: float
    delay: float
    """[s]"""
    sensitivity: float


def contenders(path: Path | None) -> tuple[Contender, ...]:
    """The agent of a file, or the shipped one, and those it is shown beside.

    All are linearised under the usual noise, LQGs at the covariance that their filters settle on; the agent, last,
    also without any, where its network bends least.
    """
    file = path or shipped()
    contract, content = read_agent(file)
    name = "imitation-default" if path is None else contract.algorithm
    config = crystal(A_CRYSTAL / MINUTE, contract.observation)
    policy = OnnxPolicy.load(file, config)
    seen = {
        name: noisy_observations(policy, contract.observation),
        f"{name} {AT_REST}": run_events(policy, config, (), [0.0]).observation,
    }
    own = []
    for label, observations in seen.items():
        near = linear_agent(content, observations, config.control_interval, config.parameters.v_0)
        own.append(Contender(label, contract.observation, lambda _: policy, near.state_space(), near.response))
    found = own[:1]
    at = [READINGS.index(channel) for channel in SEEN]
    for beside in BESIDE:
        make = registry.find_controller(beside).make
        form = linear_form(make(crystal(1.0, "measured")))

        def answer(omega: Floats, form: Any = form) -> Any:
            return response(form.controller, form.dt, omega)[:, :, at]

        found.append(Contender(beside, "measured", make, form.controller, answer))
    return (*found, *own[1:])


def joined(contender: Contender, omega: Floats, lam: float, dt: float) -> Responses:
    """A controller and a nominal puller at some frequencies."""
    plant = sampled_loop.sampled_plant(make_puller(lam=lam), dt)
    return Responses(omega, contender.answer(omega), response(plant, dt, omega)[:, 1:, :2], dt)


def one_reading(contender: Contender, dt: float) -> Floats:
    """Drives after one reading of the ring that is a metre too large, loop closed, shape (samples, 2)."""
    loop = sampled_loop.close(contender.system, make_puller(lam=MIX), dt)
    at, rows = loop.inputs.index("camera"), [loop.outputs.index(name) for name in ("v_p", "Q_H")]
    return after_one(loop.A, loop.B[:, [at]], loop.C[rows], loop.D[np.ix_(rows, [at])], READING_SAMPLES)


def margins(contender: Contender, omega: Floats, dt: float) -> list[Margins]:
    """Margins at both places on both models; NaN where something grows within a crystal.

    What grows more slowly is a network's use of its integral: no crystal feels it, and margins leave it out.
    """
    loop = sampled_loop
    rows = []
    for plant, lam in MODELS:
        growth = loop.close(contender.system, make_puller(lam=lam), dt).growth
        found = joined(contender, omega, lam, dt)
        for at in ("camera", "v_p"):
            found_margins = frequency.margins_of(found.opened(at), omega, dt, growth > A_CRYSTAL)
            rows.append(Margins(contender.name, plant, at, growth, *found_margins))
    return rows


def noise_gains(contender: Contender, dt: float) -> dict[str, float]:
    """RMS of the drives and of the pull speed's steps per white camera noise RMS, both models' mean puller."""
    omega = (np.arange(NOISE_POINTS) + 0.5) * np.pi / dt / NOISE_POINTS
    closed = joined(contender, omega, MIX, dt).closed()
    step = closed[:, 0] * (1.0 - np.exp(-1j * omega * dt))
    gains = (("pull", closed[:, 0], MM_PER_MIN), ("pull_step", step, MM_PER_MIN), ("heater", closed[:, 1], KILO))
    units = {"pull": "mm_per_min", "pull_step": "mm_per_min", "heater": "kw"}
    return {
        f"{name}_{units[name]}_per_mm": float(np.sqrt(np.mean(np.abs(values) ** 2)) * MM / scale)
        for name, values, scale in gains
    }


def apart(contender: Contender, other: Contender, dt: float) -> dict[str, list[float]]:
    """Largest relative deviation of one's local gains from the ring from another's, by drive, in each band.

    The pyrometer is held, and each knows what it asked of its own drives.
    """
    found: dict[str, list[float]] = {"pull speed": [], "heater": []}
    for low, high in pairwise(BANDS):
        omega = np.geomspace(low, high, 200)
        mine, its = (joined(each, omega, MIX, dt).drives() for each in (contender, other))
        for drive, deviation in zip(found, np.abs(mine / its - 1.0).max(axis=0), strict=True):
            found[drive].append(float(deviation))
    return found


def puller_parts(contender: Contender, episodes: int) -> dict[str, dict[str, float]]:
    """Observable RMSE and share of lost crystals when randomized gets one property of puller, on validation."""
    found = {}
    for name, scenario in {"nothing": RANDOMIZED, **parts_of(PULLER, RANDOMIZED), "all of it": PULLER}.items():
        config = make_config(scenario, observation=contender.observation)
        policy = contender.make(make_config("randomized", observation=contender.observation))
        values = metrics(rollout(policy, config, VALIDATION_SEEDS[:episodes]))
        found[name] = {
            "rmse_observable_mm": float(values.rmse_observable_mm.mean()),
            "failure_rate": float(values.failure_rate.mean()),
        }
    return found


def pictures(taking_part: Sequence[Contender], answers: Answers, jumps: Jumps, dt: float) -> dict[str, bytes]:
    """The figures, by file name."""
    from .figures import gain_figure, jump_figure, loop_figure, response_figure, share_figure

    omega = frequency.frequencies(dt)
    responses = {contender.name: joined(contender, omega, MIX, dt) for contender in taking_part}
    return {
        "responses.png": response_figure(answers, TRIALS, dt),
        "gains.png": gain_figure({each.name: one_reading(each, dt) for each in taking_part}, responses, dt),
        "loop.png": loop_figure(responses, radius_model(make_puller(lam=MIX)).zero),
        "jumps.png": jump_figure(jumps, JUMPS),
        "shares.png": share_figure(answers["load"], responses, TRIALS[1].title),
    }


def study(agent: Path | None, episodes: int, only_pictures: bool, tell: Callable[[str], None]) -> dict[str, bytes]:
    """Everything, as files by name."""
    from .report import Found, as_json, as_markdown

    tell("linearising")
    taking_part = contenders(agent)
    dt = crystal(1.0, "measured").control_interval
    omega = frequency.frequencies(dt)
    acting = [contender for contender in taking_part if not contender.name.endswith(AT_REST)]
    made = {each.name: each.make(crystal(A_CRYSTAL / MINUTE, each.observation)) for each in acting}
    answers: Answers = {}
    for trial in TRIALS:
        tell(trial.title)
        answers[trial.name] = {
            each.name: respond(made[each.name], crystal(trial.minutes, each.observation), trial) for each in acting
        }
    tell("jumps")
    jumps = {
        each.name: tuple(jump_gains(made[each.name], each.observation, noisy) for noisy in (False, True))
        for each in acting
    }
    files = pictures(taking_part, answers, jumps, dt)
    if only_pictures:
        return files
    limits: dict[str, dict[str, Any]] = {}
    parts = {}
    for each in acting:
        tell(f"limits of {each.name}")
        limits[each.name] = {limit.name: survive(made[each.name], limit, each.observation) for limit in LIMITS}
        tell(f"{each.name}, one property of the real puller at a time")
        parts[each.name] = puller_parts(each, episodes)
    rows = [row for each in taking_part for row in margins(each, omega, dt)]
    gains = {each.name: noise_gains(each, dt) for each in taking_part}
    beside = next(each for each in taking_part if each.name == BESIDE[0])
    differing = {each.name: apart(each, beside, dt) for each in taking_part if each is not beside}
    found = Found(
        read_agent(agent or shipped())[0], answers, rows, gains, limits, parts, episodes, beside.name, differing, jumps
    )
    return {**files, "insight.json": as_json(found).encode(), "insight.md": as_markdown(found).encode()}


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser(prog=PROG, description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--agent", type=Path, metavar="FILE", help="agent file in place of the shipped one")
    parser.add_argument("--episodes", type=int, default=50, metavar="N", help="validation episodes (%(default)s)")
    parser.add_argument("--pictures", action="store_true", help="draw the pictures alone; the tables stay as they are")
    parser.add_argument("--out", type=Path, default=Path("results/insight"), metavar="DIR", help="%(default)s")
    given = parser.parse_args(arguments)
    return guarded(PROG, lambda: _main(given), "benchmark")


def _main(given: argparse.Namespace) -> int:
    if not 1 <= given.episodes <= len(VALIDATION_SEEDS):
        raise ValueError(f"--episodes must be 1 to {len(VALIDATION_SEEDS)}, not {given.episodes}")
    check_writable(given.out)
    files = study(given.agent, given.episodes, given.pictures, lambda what: print(what, file=sys.stderr, flush=True))
    write_files({given.out / name: content for name, content in files.items()})
    print(files.get("insight.md", b"").decode() or f"wrote {', '.join(files)}\n", end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
