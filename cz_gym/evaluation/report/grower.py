"""The report for a puller, which a grower reads: diameters, scrap, v/G, margins of the loops, and a recommendation."""

import pkgutil
from collections.abc import Sequence
from typing import Any

import numpy as np

from cz_gym.body.plant import make_puller
from cz_gym.errors import CzError
from cz_gym.evaluation.protocol import Case
from cz_gym.evaluation.results import Result, Sample
from cz_gym.evaluation.statistics import Estimate, Resamples, means
from cz_gym.support.units import MM, PERCENT

from .tables import (
    DRIVES,
    FAILURES,
    FEWEST,
    HEATER_STEP,
    NOTHING,
    PULL_STEP,
    Column,
    crystals,
    deciding,
    label,
    too_few,
)

FORM = "cz_gym.baselines.analysis.linear_form:linear_form"
LOOP = "cz_gym.baselines.analysis.frequency:loop_margins"
"""Functions on the loops of controllers, looked up by name because this package imports no controller."""
DIAMETER = 0.5
"""Millimetre of diameter, in millimetres of radius."""
FIT = 0.01
"""Largest share of lost crystals of a controller that is recommended [-]."""
VG = Column("mean_pull_within_3pct", "v/G within 3 % [% of time]", 1, PERCENT)
BESIDE = (
    FAILURES._replace(heading="crystals lost [%]"),
    Column("rmse_mm", "diameter RMSE [mm]", 3, DIAMETER),
    Column("max_error_mm", "largest diameter error [mm]", 2, DIAMETER),
    VG,
    PULL_STEP,
    HEATER_STEP,
    next(column for column in DRIVES if column.metric == "time_at_limits"),
)
"""Columns beside the scrap."""
SHORT = 5
"""Number of them on a terminal."""
EXPLAINED = (
    "Scrap is the share of the time in which the diameter is outside the tolerance band (--tolerance); a lost crystal "
    "is scrap to the end. v/G stays within 3 % where the 30 min mean of the pull speed does."
)
MARGINS_EXPLAINED = (
    "Margins of the sampled loop, opened at the ring, near rest, on the worse of the plant's Models I and II; "
    "- for a controller without a linear form."
)
MARGINS = ("controller", "gain may grow by", "gain may fall to", "phase margin [deg]", "delay margin [s]")
"""Heads of :func:`margins`."""


def title(case: Case) -> str:
    """A heading that names the puller and its diameter."""
    return f"Puller {case.puller.name}, {2.0 * case.puller.parameters.r_0 / MM:g} mm in diameter"


def band(result: Result) -> str:
    """The tolerance band of the diameter in words."""
    return f"±{2.0 * (result.case.tolerance or 0.0) / MM:g} mm"


def scrap(sample: Sample) -> Estimate | None:
    """Share of the time in which the diameter is outside the tolerance band, to the horizon once a crystal is lost."""
    if sample.outside is None:
        return None
    return means(sample.outside[:, :, None], Resamples.draw(len(sample.seeds)))[0]


def outcome(result: Result, interval: bool = True) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Heads and rows of a scenario's table for a grower, the fewest losses first; short without ``interval``."""
    head = f"scrap: diameter outside {band(result)}" if interval else f"outside {band(result)}"
    columns = Column("", f"{head} [% of time]", 2, PERCENT), *BESIDE[: None if interval else SHORT]
    column, *beside = (each._replace(interval=interval) for each in columns)
    rows = [
        (label(sample, result), column.text(scrap(sample)), *(c.text(c.estimate(result, sample.name)) for c in beside))
        for sample in sorted(result.samples, key=lambda sample: _order([result], sample))
    ]
    return ("controller", column.heading, *(each.heading for each in beside)), rows


def _order(results: Sequence[Result], sample: Sample) -> tuple[float, float]:
    """Mean shares of lost crystals and of scrap of a contender over some scenarios."""
    own = [one for result in results for one in result.samples if one.name == sample.name]
    lost = np.mean([one.metric("failure_rate").mean() for one in own])
    return float(lost), float(np.mean([estimate.mean if (estimate := scrap(one)) else np.inf for one in own]))


def recommendation(results: Sequence[Result]) -> str:
    """Who loses the fewest crystals and, of those, makes the least scrap; bounds and a few crystals do not count."""
    counted = deciding(results)
    able, number = [one for one in counted[0].samples if not one.contender.bound], len(counted[0].seeds)
    if not able or too_few(counted):
        return f"No recommendation: {crystals(number)}, and it takes a controller and at least {FEWEST}."
    best = min(able, key=lambda sample: _order(counted, sample))
    lost, share = _order(counted, best)
    steady = np.mean([result.means[best.name][VG.metric].mean for result in counted])
    machine, who = counted[0].case.puller.name, best.name
    fate = (
        f"Recommended for {machine}: {who}, which loses {f'{lost / PERCENT:.2g} %' if lost else 'none'}"
        if lost <= FIT
        else f"No controller is fit for {machine}: {who} loses the fewest crystals, {lost / PERCENT:.2g} %"
    )
    up, down, phase, delay = _margins(best, counted[0])
    loop = (
        f" Its loop bears {down} to {up} times its gain, {phase} degrees and a delay of {delay} s."
        if delay != NOTHING
        else ""
    )
    return (
        f"{fate} of {crystals(number)} on {' and '.join(result.case.name for result in counted)}. The diameter is "
        f"outside {band(counted[0])} for {share / PERCENT:.2g} % of the time (scrap), and v/G is within 3 % for "
        f"{steady / PERCENT:.3g} %.{loop}"
    )


def margins(samples: Sequence[Sample], result: Result) -> list[tuple[str, ...]]:
    """A row for each controller: margins of its sampled loop, opened at the ring, on the worse of Models I and II."""
    return [(sample.name, *_margins(sample, result)) for sample in samples]


def _margins(sample: Sample, result: Result) -> tuple[str, ...]:
    config = result.case.config(sample.contender.observation, sample.contender.action)
    absent = (NOTHING,) * (len(MARGINS) - 1)
    if sample.contender.learned:
        return absent
    try:
        form: Any = pkgutil.resolve_name(FORM)(sample.contender.make(config), config.sole_scenario.sensor)
    except (CzError, AttributeError):  # it has no linear form, or is no feedback
        return absent
    pullers = [make_puller(config.parameters, mix, config.meniscus) for mix in (1.0, 0.0)]
    loops = [pkgutil.resolve_name(LOOP)(form.controller, puller, form.dt) for puller in pullers]
    if any(np.isnan(loop.sensitivity) for loop in loops):
        return ("unstable", *absent[1:])
    worst = (np.nanmin, "gain_up"), (np.nanmax, "gain_down"), (np.nanmin, "phase_deg"), (np.nanmin, "delay")
    values = ((pick, [getattr(loop, name) for loop in loops]) for pick, name in worst)
    return tuple("no limit" if np.isnan(both).all() else f"{pick(both):.3g}" for pick, both in values)
