"""What a report shows of whole crystals: losses by kind and stage, crown, body and tail, energy; and their picture."""

from collections.abc import Callable, Sequence
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np

from cz_gym.crystal.process import CRYSTAL
from cz_gym.crystal.recipe import FAILURE_MODES
from cz_gym.evaluation import plots
from cz_gym.evaluation.metrics import PARTS
from cz_gym.evaluation.plots import INK, canvas, chosen, example, lost, png, styles_of
from cz_gym.evaluation.protocol import Case
from cz_gym.evaluation.results import SPEED, Result
from cz_gym.evaluation.rollout import Floats
from cz_gym.support.units import KILO, MM, MM_PER_MIN, PERCENT

from . import tables
from .tables import FAILURES, HEATER_STEP, NOTHING, PULL_STEP, RETURN, RMSE, Column, Verdict, deciding, label, too_few

MOST = 6
"""Largest number of controllers in the picture."""
CROWN = Column("crown_max_mm", "crown's largest error [mm]", 2)
CROWN_95 = Column("crown_max_mm", "95 % of crowns [mm]", 2, kind="largest")
BODY = Column("body_within_half", "body within 0.5 mm [%]", 1, PERCENT)
V_OVER_G = Column("v_over_G_within_3pct", "v/G within 3 % [%]", 1, PERCENT)
TAIL_95 = Column("tail_max_mm", "95 % of tails [mm]", 2, kind="largest")
ENERGY = Column("kwh_per_kg", "energy [kWh/kg]", 2)
HOURS = Column("hours", "time [h]", 2)
ERROR = (
    CROWN, CROWN_95, Column("body_rmse_mm", "body RMSE [mm]", 3), BODY, V_OVER_G,
    Column("v_over_G_within_10pct", "v/G within 10 % [%]", 1, PERCENT),
    Column("tail_max_mm", "tail's largest error [mm]", 2), TAIL_95, FAILURES,
)  # fmt: skip
DRIVES = (
    HOURS, ENERGY, Column("dopant_spread", "dopant's spread [%]", 1, PERCENT), PULL_STEP, HEATER_STEP, RMSE,
    Column("cost", "cost", 4), RETURN, Column(SPEED, "compute [us/step]", 2),
)  # fmt: skip
SHORT = tuple(
    column._replace(interval=False)
    for column in (FAILURES, CROWN, CROWN_95, BODY, V_OVER_G, TAIL_95, HOURS, ENERGY, PULL_STEP)
)
_OVERVIEW = ((CROWN_95, 0), (BODY, 1), (V_OVER_G, 1), (TAIL_95, 2), (ENERGY, 1))
"""Columns of the overview, with the part of the crystal whose case they are taken from."""


def grows(results: Sequence[Result], part: int) -> Result:
    """The first result whose stage is a part of the crystal, or the whole; else the first one."""
    return next((each for each in results if each.case.stage in (PARTS[part], "whole")), results[0])


def overview(results: Sequence[Result]) -> tuple[tuple[str, ...], dict[str, list[tuple[str, ...]]]]:
    """Return heads, and rows by what contenders knew: losses on each case, then what counts in crown, body and tail."""
    groups: dict[str, list[tuple[str, ...]]] = {}
    for sample in results[0].samples:
        failures = " / ".join(_plain(FAILURES, result, sample.name) for result in results)
        cells = (_plain(column, grows(results, part), sample.name) for column, part in _OVERVIEW)
        groups.setdefault(sample.contender.knows, []).append((label(sample, results[0]), failures, *cells))
    lost_on = f"lost of {' / '.join(result.case.name for result in results)} [%]"
    return ("controller", lost_on, *(column.heading for column, _ in _OVERVIEW)), groups


def _plain(column: Column, result: Result, name: str) -> str:
    return column._replace(interval=False).text(column.estimate(result, name))


def verdict(results: Sequence[Result], column: Column = RMSE) -> Verdict:
    """Say which controller that reads sensors loses the fewest crystals, and has the least error in the crown."""
    able = [sample.name for sample in results[0].samples if not sample.contender.bound]
    if not able:
        return Verdict("No controller that reads sensors took part in this run.")
    if few := too_few(deciding(results)):
        return Verdict(few)
    crown, body = grows(results, 0), grows(results, 1)

    def losses(name: str) -> float:
        return round(sum(result.means[name][FAILURES.metric].mean for result in results), 9)

    fewest = [name for name in able if losses(name) == min(map(losses, able))]
    best = min(fewest, key=lambda name: crown.means[name][RMSE.metric].mean)
    lost_of = ", ".join(f"{_plain(FAILURES, result, best)} % of {result.case.name}" for result in results)
    crowns, bodies = _plain(CROWN_95, crown, best), _plain(BODY, body, best)
    who = f"{', '.join(fewest[:-1])} and {fewest[-1]} lose" if len(fewest) > 1 else f"{best} loses"
    said = [f"{who} the fewest crystals" + (f", {lost_of}" if len(fewest) == 1 else "")]
    said += [f"of them {best}, which loses {lost_of}, has the least error in the crown"] if len(fewest) > 1 else []
    said += [f"95 % of its crowns are at most {crowns} mm off"] if crowns != NOTHING else []
    said += [f"{bodies} % of the body is within 0.5 mm"] if bodies != NOTHING else []
    return Verdict(f"{'; '.join(said)}.")


def losses(result: Result) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Heads, and a row a contender: how many crystals it lost in each part, and how."""
    lines = []
    for sample in result.samples:
        cells = []
        for part in PARTS:
            where = sample.metric(f"lost_in_{part}")
            counts = {way: int((where * sample.metric(way)).sum()) for way in FAILURE_MODES}
            cells.append(", ".join(f"{number} {way}" for way, number in counts.items() if number) or NOTHING)
        lines.append((label(sample, result), *cells))
    return ("controller", *(f"lost in {part}" for part in PARTS)), lines


class _Panel(NamedTuple):
    label: str
    value: Callable[[Any], Floats]
    reference: Callable[[Any], Floats] | None = None


_PANELS = (
    _Panel("radius error [mm]", lambda s: (s.r_c - s.r_ref) / MM),
    _Panel("pull speed [mm/min]", lambda s: s.v_p / MM_PER_MIN, lambda s: s.v_p_ref / MM_PER_MIN),
    _Panel("heater power [kW]", lambda s: s.Q_H / KILO, lambda s: s.Q_H_ref / KILO),
    _Panel("meniscus height [mm]", lambda s: s.h_c / MM, lambda s: s.h_ref / MM),
    _Panel("v/G, relative", lambda s: s.v_over_G, lambda s: np.ones_like(s.L)),
)
TALLEST, WIDE = 6.0, 8.0
"""Height of the largest profile, and width of the figure [in]."""
POINTS = 2000
"""Most points of a line."""


def draw(result: Result) -> bytes:
    """Draw the first crystal of a stage under each controller: its profile to scale, and its signals by length."""
    samples, style = chosen(result.samples, MOST), styles_of(result.samples)
    signals = {sample.name: _thinned(example(sample)) for sample in samples}
    longest = max(signals.values(), key=lambda s: s.L[-1])
    room = 1.1 * longest.r_ref.max() / MM
    ends = float(longest.L[0] / MM), float(longest.L[-1] / MM)
    tall = min(TALLEST, WIDE / len(samples) * (ends[1] - ends[0]) / (2.0 * room) + 0.5)
    figure = canvas(WIDE, tall + 1.15 * len(_PANELS) + 1.0)
    halves: Any = figure.subfigures(2, 1, height_ratios=(tall + 0.3, 1.15 * len(_PANELS)))
    above, below = halves
    profiles = above.subplots(1, len(samples), sharex=True, sharey=True, squeeze=False)[0]
    for axis, sample in zip(profiles, samples, strict=True):
        s, look = signals[sample.name], style[sample.name]
        for side in (-1.0, 1.0):
            axis.plot(side * longest.r_ref / MM, longest.L / MM, color=INK, lw=0.8, ls="--")
        axis.fill_betweenx(s.L / MM, -s.r_c / MM, s.r_c / MM, color=look.colour, alpha=0.45, lw=0)
        axis.set_title(f"{fill(sample.name, 12)}{', lost' * lost(sample)}", fontsize=8, color=INK)
        axis.set(aspect="equal", xlim=(-room, room), ylim=ends[::-1])
    profiles[0].set_ylabel("length [mm]")
    profiles[len(samples) // 2].set_xlabel("radius [mm]")
    axes: Any = below.subplots(len(_PANELS), 1, sharex=True)
    for axis, panel in zip(axes, _PANELS, strict=True):
        for sample in samples:
            s = signals[sample.name]
            axis.plot(s.L / MM, panel.value(s), color=style[sample.name].colour, lw=0.9)
        if panel.reference:
            axis.plot(longest.L / MM, panel.reference(longest), color=INK, lw=0.8, ls="--")
        limits = np.concatenate(
            [panel.value(signals[each.name]) for each in samples if not lost(each)] or [np.arange(2.0)]
        )
        low, high = np.quantile(limits, (0.001, 0.999))
        axis.set(xlim=ends, ylim=(low - 0.1 * (high - low), high + 0.1 * (high - low)))
        axis.set_ylabel(panel.label.replace(" [", "\n["))
    axis.set_xlabel("length [mm]")
    figure.suptitle(
        f"One crystal, {result.case.name} (test seed {samples[0].seeds[0]:,}); dashed: the recipe", fontsize=10.5
    )
    return png(figure)


def _thinned(s: Any) -> Any:
    """The signals at no more than :data:`POINTS` steps."""
    step = -(-len(s.L) // POINTS)
    return type(s)(*(signal[::step] for signal in s))


# What the report of a process shows: its tables, its verdict and the picture of one crystal.

Table = tuple[tuple[str, ...], list[tuple[str, ...]]]
"""Heads and rows."""


class Contents(NamedTuple):
    """The parts of a report."""

    overview: Callable[[Sequence[Result]], tuple[tuple[str, ...], dict[str, list[tuple[str, ...]]]]]
    verdict: Callable[..., Verdict]
    columns: tuple[tuple[Column, ...], ...]
    """Columns of a case's tables of metrics."""
    short: tuple[Column, ...]
    """Columns on a terminal."""
    losses: Callable[[Result], Table] | None
    """How crystals were lost, if there are several ways and parts."""
    picture: Callable[[Result], bytes]
    """The first crystal of a case, as PNG."""


_BODY = Contents(tables.overview, tables.verdict, (tables.ERROR, tables.DRIVES), tables.SHORT, None, plots.crystal)
_CRYSTAL = Contents(
    overview,
    verdict,
    (ERROR, DRIVES),
    SHORT,
    losses,
    draw,
)


def contents_of(case: Case) -> Contents:
    """The parts of the report of a case's process."""
    return _CRYSTAL if case.process == CRYSTAL else _BODY
