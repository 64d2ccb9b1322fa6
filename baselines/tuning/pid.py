"""Tune a PID controller within a budget: ``python -m cz_gym.baselines.tuning.pid --controller paper-tuned``.

Optuna's tree-structured Parzen estimator explores on the first training seeds, always the same; steps around the best
design then refine it; the best few meet the first validation seeds, and the best there is chosen. Test seeds are never
touched. Every trial is kept in ``history.csv``; the same command goes on where it stopped.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cz_gym.atomic_files import check_writable, write_files
from cz_gym.baselines.optional import require
from cz_gym.commands import OneLineParser, guarded
from cz_gym.config import Config, make_config
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.protocol import TRAINING_SEEDS, VALIDATION_SEEDS
from cz_gym.evaluation.rollout import rollout
from cz_gym.units import MM_PER_MIN

from .pid_spaces import Knob, Space, reading, space_of, turned

TRAINING, VALIDATION = TRAINING_SEEDS, VALIDATION_SEEDS
"""Seeds: the first ones of each are used."""
STEP_PRICE, EXCESS_PRICE, FAILURE_PRICE, RULE_PRICE = 0.2, 20.0, 5.0, 2.0
"""Prices of pull step RMS and its excess over what is allowed [mm per mm/min], of failures and broken rules [mm]."""
EXPLORE = 0.4
"""Share of the trials that explore; the others refine."""
STEPS = (0.01, 0.15)
"""Standard deviations of a refining step, in parts of a knob's range."""
DIGITS = 4
"""Significant digits that a knob is turned to."""


SURVIVE = "hard"
"""Scenario whose episodes a design tuned on ``randomized`` has to survive as well."""


class Episodes(NamedTuple):
    """What a design is judged on."""

    config: Config
    seeds: Sequence[int]
    survive: Sequence[int]
    """Seeds of the episodes of SURVIVE, for designs tuned on ``randomized``."""


class Score(NamedTuple):
    """What a design costs on some episodes."""

    objective: float
    """Mean RMSE against what a sensor can show, plus the priced pull steps, failures and broken rules [mm]."""
    rmse_mm: float
    pull_step_rms_mm_per_min: float
    failure_rate: float
    rule_excess: float


class Trial(NamedTuple):
    """One design tried."""

    values: tuple[float, ...]
    """Where the knobs stood, in the order of the space."""
    score: Score


def build(space: Space, values: Sequence[float]) -> Any:
    """The controller with its knobs turned."""
    policy = space.base
    for knob, value in zip(space.knobs, values, strict=True):
        policy = turned(policy, knob.path, value)
    return policy


def score(space: Space, values: Sequence[float], episodes: Episodes) -> Score:
    """Cost of a design on those episodes."""
    policy = build(space, values)
    found = metrics(rollout(policy, episodes.config, episodes.seeds))
    rmse, step = float(found.rmse_observable_mm.mean()), float(found.pull_step_rms_mm_per_min.mean())
    failed = found.failure_rate
    if len(episodes.survive):
        harder = rollout(policy, episodes.config.with_scenario(SURVIVE), episodes.survive)
        failed = np.concatenate([failed, harder.failed])
    failures, broken = float(failed.mean()), space.rule(policy)
    excess = max(0.0, step - space.allowed_step / MM_PER_MIN)
    cost = rmse + STEP_PRICE * step + EXCESS_PRICE * excess + FAILURE_PRICE * failures + RULE_PRICE * broken
    return Score(cost, rmse, step, failures, broken)


def first_values(space: Space) -> tuple[float, ...]:
    """The base's own knobs, held inside their ranges."""
    return tuple(float(np.clip(reading(space.base, knob.path), knob.low, knob.high)) for knob in space.knobs)


def read_history(path: Path, space: Space) -> list[Trial]:
    """Trials kept so far; ValueError if the file is of another search."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        rows = list(csv.reader(file))
    if not rows or rows[0] != _header(space):
        raise ValueError(f"{path} holds another search than {space.name}'s; move it away or choose another --out")
    count = len(space.knobs)
    numbers = [[float(entry) for entry in row] for row in rows[1:]]
    return [Trial(tuple(row[:count]), Score(*row[count:])) for row in numbers]


def write_history(path: Path, space: Space, trials: Sequence[Trial]) -> None:
    """Keep the trials as CSV."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(_header(space))
    writer.writerows([*trial.values, *(f"{number:.6g}" for number in trial.score)] for trial in trials)
    write_files({path: out.getvalue().encode()})


def _header(space: Space) -> list[str]:
    return [*(knob.path for knob in space.knobs), *Score._fields]


def search(space: Space, episodes: Episodes, trials: int, path: Path, seed: int = 0) -> list[Trial]:
    """Run the search up to that many trials in all, going on from the history at ``path``."""
    optuna, tqdm = require("optuna", "agents"), require("tqdm").tqdm
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    done = read_history(path, space)
    ranges = {k.path: optuna.distributions.FloatDistribution(k.low, k.high, log=k.log) for k in space.knobs}
    study = optuna.create_study(sampler=_sampler(optuna, seed + len(done)))
    for trial in done:
        _tell(optuna, study, ranges, trial)
    bar = tqdm(range(len(done), trials), desc=space.name, initial=len(done), total=trials, disable=None)
    for number in bar:
        if number == 0:
            wanted = first_values(space)
        elif number < EXPLORE * trials:
            asked = study.ask(ranges)
            wanted = tuple(asked.params[knob.path] for knob in space.knobs)
            study.tell(asked, state=optuna.trial.TrialState.FAIL)  # what is told is the rounded design
        else:
            best = min(done, key=lambda trial: trial.score.objective)
            wanted = refined(space, best.values, np.random.default_rng([seed, number]))
        values = tuple(float(f"{value:.{DIGITS}g}") for value in wanted)
        trial = Trial(values, score(space, values, episodes))
        _tell(optuna, study, ranges, trial)
        done.append(trial)
        write_history(path, space, done)
        bar.set_postfix(best=f"{min(t.score.objective for t in done):.4f}")
    return done


def refined(space: Space, values: Sequence[float], random: np.random.Generator) -> tuple[float, ...]:
    """A step from there: about half of the knobs, by a normal step whose size is drawn as well."""
    size = math.exp(random.uniform(math.log(STEPS[0]), math.log(STEPS[1])))
    moved = size * random.standard_normal(len(values)) * (random.random(len(values)) < 0.5)
    return tuple(_moved(knob, value, part) for knob, value, part in zip(space.knobs, values, moved, strict=True))


def _moved(knob: Knob, value: float, part: float) -> float:
    wanted = value * (knob.high / knob.low) ** part if knob.log else value + (knob.high - knob.low) * part
    return float(np.clip(wanted, knob.low, knob.high))


def _sampler(optuna: Any, seed: int) -> Any:
    return optuna.samplers.TPESampler(seed=seed, n_startup_trials=30, n_ei_candidates=48, multivariate=False)


def _tell(optuna: Any, study: Any, ranges: Any, trial: Trial) -> None:
    held = {path: float(np.clip(v, d.low, d.high)) for (path, d), v in zip(ranges.items(), trial.values, strict=True)}
    study.add_trial(optuna.trial.create_trial(params=held, distributions=ranges, value=trial.score.objective))


def choose(space: Space, trials: Sequence[Trial], finalists: int, episodes: Episodes) -> tuple[Trial, ...]:
    """The best of the search on other episodes, best first there."""
    best = sorted(dict.fromkeys(trials), key=lambda trial: trial.score.objective)[:finalists]
    judged = [Trial(trial.values, score(space, trial.values, episodes)) for trial in best]
    return tuple(sorted(judged, key=lambda trial: trial.score.objective))


def report(
    space: Space, trials: Sequence[Trial], judged: Sequence[Trial], training: Episodes, validation: Episodes
) -> str:
    """What was chosen and how, as JSON."""
    names = [knob.path for knob in space.knobs]
    told = {
        "controller": space.name,
        "scenario": training.config.scenario.name,
        "scenario_hash": training.config.scenario.hash,
        "trials": len(trials),
        "training_seeds": [training.seeds[0], training.seeds[-1]],
        "validation_seeds": [validation.seeds[0], validation.seeds[-1]],
        f"episodes_of_{SURVIVE}_to_survive": [len(training.survive), len(validation.survive)],
        "chosen": dict(zip(names, judged[0].values, strict=True)),
        "finalists_on_validation": [trial.score._asdict() for trial in judged],
    }
    return json.dumps(told, indent=2) + "\n"


def check(args: argparse.Namespace) -> None:
    """ValueError for a budget out of range."""
    ranges = {"trials": (1, 100_000), "episodes": (1, 10_000), "survive": (0, 10_000), "finalists": (1, 1000)}
    for name, (least, most) in {**ranges, "validation": (1, len(VALIDATION))}.items():
        if not least <= getattr(args, name) <= most:
            raise ValueError(f"--{name} must be between {least} and {most}, not {getattr(args, name)}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser(prog="python -m cz_gym.baselines.tuning.pid", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--controller", required=True, help="paper-tuned, paper-filtered, pid-conventional, industrial")
    parser.add_argument("--scenario", default="randomized", help="scenario to tune on")
    parser.add_argument("--trials", type=int, default=60, help="trials in all, those of an earlier run included")
    parser.add_argument("--episodes", type=int, default=60, help="training episodes a trial")
    parser.add_argument("--survive", type=int, default=30, help="training episodes of hard to survive, on randomized")
    parser.add_argument("--finalists", type=int, default=8, help="designs that meet the validation seeds")
    parser.add_argument("--validation", type=int, default=200, help="validation episodes, at most 500")
    parser.add_argument("--seed", type=int, default=0, help="seed of the search")
    parser.add_argument("--out", type=Path, default=Path("results/tuning"), help="folder of histories and choices")
    args = parser.parse_args(arguments)
    left = "the same command goes on from the trials in its history"
    return guarded(parser.prog, lambda: _tune(args), "benchmark", left)


def _tune(args: argparse.Namespace) -> int:
    check(args)
    config = make_config(args.scenario)
    space = space_of(args.controller, config.scenario.name)
    folder = args.out / space.name / config.scenario.name
    check_writable(folder)
    survive = args.survive if config.scenario.name == "randomized" else 0
    training = Episodes(config, TRAINING[: args.episodes], TRAINING[:survive])
    validation = Episodes(config, VALIDATION[: args.validation], VALIDATION[: args.validation * (survive > 0)])
    trials = search(space, training, args.trials, folder / "history.csv", args.seed)
    judged = choose(space, trials, args.finalists, validation)
    write_files({folder / "chosen.json": report(space, trials, judged, training, validation).encode()})
    print(f"{space.name} on {config.scenario.name}: {judged[0].score}")
    print(build(space, judged[0].values))
    return 0


if __name__ == "__main__":
    sys.exit(main())
