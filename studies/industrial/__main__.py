"""Does the plant look like the logs? ``python -m studies.industrial`` measures the logged facts on this plant, under
the ``industrial`` law on validation episodes.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.signal import correlate

from cz_gym.baselines.pid.settings import tuned
from cz_gym.baselines.policy import Floats
from cz_gym.commands import OneLineParser, between
from cz_gym.config import make_config
from cz_gym.errors import CzError
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.evaluation.rollout import Rollout, rollout
from cz_gym.units import MINUTE, MM, MM_PER_MIN

SETTLED = 30.0 * MINUTE
"""Start of the analysed part, past the transient of the start [s]."""
LAG = 60.0
"""Time scale of the identification [s]."""


class Facts(NamedTuple):
    """What the logs report, and what the plant gives: one number each."""

    diameter_error_mm: float
    """RMS of the diameter error [mm]."""
    correlation_min: float
    """Median time after which the error's autocorrelation falls below 1/e [min]."""
    dead_zone_share: float
    """Share of time with the diameter error between 1 and 2 mm [-]."""
    negative_lobe: float
    """Median depth of the autocorrelation's negative lobe within an hour [-]."""
    pull_gain: float
    """Gain from pull speed to diameter that a first-order fit at 60 s finds [mm per mm/min]; physics says negative."""


LOGGED = Facts(1.1, 13.0, 0.111, 0.0, 2.65)
"""The public analysis of 38 logged segments."""


def autocorrelation(error: Floats, lags: int) -> Floats:
    """Autocorrelation of one course at lags 0 to ``lags``, mean removed."""
    centred = error - error.mean()
    products: Floats = correlate(centred, centred)[len(centred) - 1 :][: lags + 1]
    course: Floats = products / products[0]
    return course


def identified_gain(diameter: Floats, pull: Floats, samples: int) -> float:
    """Least-squares b of d(k+1) = a d(k) + b v(k) at every ``samples``-th sample, as from plain closed-loop logs."""
    d, v = diameter[::samples], pull[::samples]
    columns = np.stack([d[:-1], v[:-1]], axis=-1).reshape(-1, 2)
    solution = np.linalg.lstsq(columns, d[1:].reshape(-1), rcond=None)[0]
    return float(solution[1])


def facts(run: Rollout) -> Facts:
    """The facts of a rollout, failed episodes left out; ValueError if all failed."""
    kept = ~run.failed
    if not kept.any():
        raise CzError("every episode failed: there is no operation to describe")
    dt = run.config.control_interval
    first, lags = round(SETTLED / dt), round(60.0 * MINUTE / dt)
    signals = run.signals
    ring = 2.0 * (signals.r_br_measured - signals.r_ref)[first:, kept] / MM
    # A ring is brighter outside the crystal by each puller's own bias; a log shows what is left.
    error = ring - np.median(ring, axis=0)
    true = 2.0 * (signals.r_c - signals.r_ref)[first:, kept] / MM
    courses = [autocorrelation(column, lags) for column in true.T]
    times = [float(np.argmax(course < 1.0 / np.e)) * dt / MINUTE for course in courses]
    size = np.abs(true)
    return Facts(
        float(np.sqrt(np.mean(np.square(true)))),
        float(np.median(times)),
        float(np.mean((size >= 1.0) & (size < 2.0))),
        float(np.median([min(course.min(), 0.0) for course in courses])),
        identified_gain(error, (signals.v_p[first:, kept] - run.config.parameters.v_0) / MM_PER_MIN, round(LAG / dt)),
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser(prog="python -m studies.industrial", description="the logged facts")
    most = len(VALIDATION_SEEDS)
    parser.add_argument("--episodes", type=between(1, most), default=100, help=f"validation episodes, at most {most}")
    parser.add_argument("--scenario", default="randomized")
    parser.add_argument("--model", choices=["I", "II"], help="one model instead of the scenario's mix")
    return parser.run(_check, arguments, "benchmark")


def _check(args: argparse.Namespace) -> None:
    config = make_config(args.scenario, args.model)
    found = facts(rollout(tuned("industrial", config), config, VALIDATION_SEEDS[: args.episodes]))
    print(f"{'':<20}{'logged':>10}{'here':>10}")
    for name, logged, here in zip(Facts._fields, LOGGED, found, strict=True):
        print(f"{name:<20}{logged:>10.3g}{here:>10.3g}")


if __name__ == "__main__":
    sys.exit(main())
