"""What the search turns of ``PPO()``, and the history of what it tried."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from cz_gym.agents.training.recipes import PPO
from cz_gym.atomic_files import write_files

DIGITS = 4
"""Significant digits that a knob is turned to."""


class Knob(NamedTuple):
    """One number of the recipe and its range."""

    name: str
    low: float
    high: float
    log: bool = False
    whole: bool = False


KNOBS = (
    Knob("learning_rate", 1e-4, 4e-3, log=True),
    Knob("actor_pace", 0.01, 1.0, log=True),
    Knob("horizon", 10.0, 500.0, log=True),
    Knob("gae_lambda", 0.5, 0.99),
    Knob("clip_range", 0.03, 0.4, log=True),
    Knob("batch_doublings", 10, 15, whole=True),
    Knob("n_epochs", 1, 10, whole=True),
    Knob("pull_noise", 1e-3, 3e-2, log=True),
    Knob("heater_noise", 3e-5, 3e-3, log=True),
    Knob("critic_share", 0.05, 0.6),
)
"""Everything that is searched; ``horizon`` is 1 / (1 - gamma) in steps, ``batch_doublings`` the base-two logarithm of
the batch size, ``critic_share`` the share of the steps in which only the critic learns."""
Values = tuple[float, ...]
"""Where the knobs stand, in their order."""


class Trial(NamedTuple):
    """One setting tried."""

    values: Values
    pruned: bool
    """Whether it was given up on the way."""
    cost: float
    """Of the last agent on the crystals that judge, less that of the imitation it began as [-]; of a pruned one on
    those that it was given up on."""
    rmse_um: float
    """The same of the true-radius RMSE [um]; nan for a pruned one."""
    seconds: float
    course: Values
    """Cost less the imitation's at each validation on the way."""
    steps: int
    """Environment steps that it was meant to last."""


HEADER = (
    "trial",
    *(knob.name for knob in KNOBS),
    "pruned",
    "cost_less_start",
    "rmse_um_less_start",
    "seconds",
    "course",
    "steps",
)


def values_of(choice: PPO) -> Values:
    """Where the knobs of these settings stand."""
    return (
        choice.learning_rate,
        choice.actor_pace,
        1.0 / (1.0 - choice.gamma),
        choice.gae_lambda,
        choice.clip_range,
        math.log2(choice.batch_size),
        float(choice.n_epochs),
        *choice.noise,
        choice.critic_steps / choice.steps,
    )


def settings_of(values: Values, steps: int) -> PPO:
    """``PPO()`` with its knobs turned, for so many steps."""
    told = dict(zip((knob.name for knob in KNOBS), values, strict=True))
    return replace(
        PPO(),
        steps=steps,
        learning_rate=told["learning_rate"],
        actor_pace=told["actor_pace"],
        gamma=1.0 - 1.0 / told["horizon"],
        gae_lambda=told["gae_lambda"],
        clip_range=told["clip_range"],
        batch_size=2 ** round(told["batch_doublings"]),
        n_epochs=round(told["n_epochs"]),
        noise=(told["pull_noise"], told["heater_noise"]),
        critic_steps=round(told["critic_share"] * steps),
    )


def rounded(values: Sequence[float]) -> Values:
    """The same to a few digits, as they are kept."""
    return tuple(float(f"{value:.{DIGITS}g}") for value in values)


def read_history(path: Path, steps: int) -> list[Trial]:
    """Trials of that many steps kept so far; ValueError if the file is of another search or damaged."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        rows = list(csv.reader(file))
    if not rows or tuple(rows[0]) != HEADER:
        raise ValueError(f"{path} holds another search; move it away or choose another --out")
    try:
        trials = [_read(row) for row in rows[1:]]
    except (ValueError, IndexError):
        raise ValueError(f"{path}: damaged; move it away or choose another --out") from None
    for trial in trials:
        if trial.steps != steps:
            raise ValueError(f"{path} holds trials of --steps {trial.steps}, not {steps}; choose another --out")
    return trials


def _read(row: Sequence[str]) -> Trial:
    count = 1 + len(KNOBS)
    values = tuple(map(float, row[1:count]))
    pruned, cost, rmse, seconds, course, steps = row[count:]
    numbers = tuple(map(float, course.split()))
    if pruned not in ("0", "1") or not all(map(math.isfinite, (*values, *numbers, float(cost)))):
        raise ValueError(row)
    return Trial(values, pruned == "1", float(cost), float(rmse), float(seconds), numbers, int(steps))


def write_history(path: Path, trials: Sequence[Trial]) -> None:
    """Keep the trials as CSV."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(HEADER)
    for number, trial in enumerate(trials):
        found = (f"{trial.cost:.5g}", f"{trial.rmse_um:.5g}", f"{trial.seconds:.0f}")
        course = " ".join(f"{cost:.4g}" for cost in trial.course)
        writer.writerow((number, *trial.values, int(trial.pruned), *found, course, trial.steps))
    write_files({path: out.getvalue().encode()})
