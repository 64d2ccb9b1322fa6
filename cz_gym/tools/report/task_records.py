"""Task records: everything of the benchmark that differs between ``Cz-v0`` and ``CzCrystal-v0``.

A record has the scenarios, controllers and metrics of an environment, and what a report shows of it: columns, the
overview, the verdict, losses, the panels of a picture. Another process is reported as ``Cz-v0``.
"""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from cz_gym.body.signals import PULL_TOLERANCE, TOLERANCE
from cz_gym.crystal.recipe import FAILURE_MODES
from cz_gym.evaluation.metrics import (
    ALMOST,
    PARTS,
    PULL_WINDOW,
    SPEED,
    CrystalMetrics,
    Metrics,
    crystal_metrics,
    metrics,
    names_of,
)
from cz_gym.evaluation.protocol import CASES, CRYSTAL_CASES, REFERENCE, Case, Contender
from cz_gym.evaluation.rollout import Floats, Rollout
from cz_gym.support.units import HOUR, KILO, MM, MM_PER_MIN, PERCENT
from cz_gym.tools import registry
from cz_gym.tools.episodes import Benchmark

from .tables import (
    COST,
    FAILURES,
    HEATER_STEP,
    MEAN_PULL,
    NOTHING,
    PULL_STEP,
    RETURN,
    RMSE,
    Column,
    Groups,
    Table,
    deciding,
    label,
    too_few,
)


class Verdict(NamedTuple):
    """One sentence on who controls best, with a table."""

    sentence: str
    heads: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    """Rows of the table, one a scenario; empty if there is no verdict."""


class Panel(NamedTuple):
    """Lines over time that share an axis."""

    title: str
    unit: str
    scale: float
    """Size of the unit in SI units."""
    lines: Mapping[str, Callable[[Any, float], Floats]]
    """Lines by name, each a function of an episode's signals and the operator's bias [m], in SI units."""
    levels: tuple[float, ...] = ()
    """Values that are marked [unit]."""


PANELS = (
    Panel(
        "radius error", "mm", MM,
        {"camera": lambda s, bias: s.r_br_measured - bias - s.r_ref, "true": lambda s, bias: s.r_c - s.r_ref},
        (-TOLERANCE / MM, 0.0, TOLERANCE / MM),
    ),
    Panel("pull speed", "mm/min", MM_PER_MIN, {"true": lambda s, bias: s.v_p}),
    Panel("heater power", "kW", KILO, {"true": lambda s, bias: s.Q_H}),
    Panel("meniscus height", "mm", MM, {"true": lambda s, bias: s.h_c}),
)  # fmt: skip
_RECIPES: dict[str, Callable[[Any, float], Floats]] = {
    "pull speed": lambda s, bias: s.v_p_ref,
    "heater power": lambda s, bias: s.Q_H_ref,
    "meniscus height": lambda s, bias: s.h_ref,
}
CRYSTAL_PANELS = (
    PANELS[0]._replace(lines={"true": PANELS[0].lines["true"]}),
    *(each._replace(lines={**each.lines, "recipe": line} if (line := _RECIPES.get(each.title)) else each.lines)
      for each in PANELS[1:]),
    Panel("v/G by the recipe's", "1", 1.0, {"true": lambda s, bias: s.v_over_G}, (1.0,)),
)  # fmt: skip
"""Panels of a whole crystal; the ring is not where the recipe's ring is while the radius is off."""

# Cz-v0: three hours of the body.

BODY_ERROR = (
    RMSE,
    Column("rmse_observable_mm", "observable RMSE [mm]", 3),
    Column("max_error_mm", "largest error [mm]", 2),
    Column("within_half_mm", "within 0.5 mm [%]", 1, PERCENT),
    FAILURES,
    Column("rmse_survivors_mm", "RMSE of the others [mm]", 3),
    Column("ground_off_pct", "ground off [%]", 2),
)
BODY_DRIVES = (
    Column("pull_rms_mm_per_min", "pull RMS [mm/min]", 3),
    PULL_STEP,
    MEAN_PULL,
    HEATER_STEP,
    Column("time_at_limits", "at the drives' limits [%]", 1, PERCENT),
    Column("growth_rate_rms_mm_per_min", "growth rate RMS [mm/min]", 3),
    COST,
    RETURN,
    Column(SPEED, "compute [us/step]", 2),
)
BODY_SHORT = (
    FAILURES._replace(heading="lost [%]", interval=False),
    COST,
    RMSE._replace(interval=False),
    PULL_STEP._replace(heading="pull step [mm/min]", interval=False),
    HEATER_STEP._replace(heading="heater step [kW]", interval=False),
    Column("max_error_mm", "max [mm]", 2, interval=False),
    Column(SPEED, "compute [us/step]", 2),
    COST._replace(heading=f"cost less {REFERENCE}'s", kind="difference", interval=False),
)
"""Columns on a terminal."""


def body_overview(benchmark: Benchmark) -> Groups:
    """Return heads, and rows by what contenders knew: RMSE and failures on each scenario, drives on the first."""
    cases, first = benchmark.cases, benchmark.cases[0]
    alone = [column._replace(interval=False) for column in (COST, MEAN_PULL, PULL_STEP, HEATER_STEP)]
    groups: dict[str, list[tuple[str, ...]]] = {}
    for each in benchmark.contenders:
        name = each.name
        errors = (RMSE.of(benchmark, case, name) for case in cases)
        drives = (column.of(benchmark, first, name) for column in alone)
        failures = " / ".join(FAILURES._replace(interval=False).of(benchmark, case, name) for case in cases)
        groups.setdefault(each.knows, []).append((label(benchmark, first, name), *errors, *drives, failures))
    heads = "controller", *(case.name for case in cases), *(column.heading for column in alone)
    return (*heads, FAILURES.heading), groups


def body_verdict(benchmark: Benchmark, column: Column = COST) -> Verdict:
    """Compare the classical controller that ranks first on each scenario with the learned agents, bounds left out.

    Crystals lost rank first, then cost (:meth:`Benchmark.rank`); ``column`` has the form of the costs. A few crystals
    of a random scenario give no verdict.
    """
    groups: dict[str, list[str]] = {}
    for each in benchmark.contenders:
        if each.learned and not each.bound:
            groups.setdefault(each.knows, []).append(each.name)
    cases = deciding(benchmark)
    if not groups:
        return Verdict("No learned agent took part in this run.")
    if benchmark.rival(cases[0]) is None:
        return Verdict("No classical controller took part in this run to compare the agents with.")
    if few := too_few(benchmark):
        return Verdict(few)
    heads = ["cost", "best classical"]
    for group in groups:
        heads += [f"best {group}", "difference"]
    where: dict[str, list[str]] = {"a classical controller": [], "a learned agent": [], "": []}
    rows = []
    for case in cases:
        winner, row = _compare_kinds(benchmark, case, groups, column)
        where[winner].append(case.name)
        rows.append(row)
    return Verdict(_sentence(where), (*heads, "ranks first"), tuple(rows))


def _compare_kinds(
    benchmark: Benchmark, case: Case, groups: Mapping[str, Sequence[str]], column: Column
) -> tuple[str, tuple[str, ...]]:
    """Return the kind that ranks first on a scenario, "" for neither, and the scenario's row."""
    rival, differences = str(benchmark.rival(case)), benchmark.verdicts(case)
    ahead = {name: benchmark.outranks(case, name) for name in differences}

    def rank(name: str) -> tuple[float, float]:
        return benchmark.rank([case], name)

    won = [name for name, before in ahead.items() if before]
    best = min(won, key=rank) if won else rival
    row = [f"{rival} {column.of(benchmark, case, rival)}"]
    for names in groups.values():
        name = min(names, key=rank)
        row += [f"{name} {column.of(benchmark, case, name)}", COST.text(differences[name])]
    clear = won or all(before is False for before in ahead.values())
    winner = "a learned agent" if won else "a classical controller" if clear else ""
    return winner, (case.name, *row, best if clear else "no difference shown")


def _sentence(where: Mapping[str, Sequence[str]]) -> str:
    """Say on which scenarios each kind of controller ranks first, "" for neither."""
    total = sum(map(len, where.values()))

    def listed(names: Sequence[str]) -> str:
        some = " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
        return f"all {total} scenarios" if len(names) == total > 1 else some

    places = {kind: listed(names) for kind, names in where.items() if names}
    first = ", ".join(f"{kind} on {place}" for kind, place in places.items() if kind)
    if not first:
        return f"No difference is shown between classical controllers and learned agents on {places['']}."
    neither = f"; on {places['']} no difference is shown" if "" in places else ""
    return f"By crystals lost, then by cost, the first is {first}{neither}."


INTERVALS = (
    "The tables show means over crystals with 95 % bootstrap intervals; a scenario without randomness is one crystal "
    "and has no interval."
)


def _none_lost(benchmark: Benchmark) -> str:
    most = max(len(benchmark.seeds(case)) for case in benchmark.cases)
    return f"No failure in n crystals still allows a rate of up to 3/n, {3 / most / PERCENT:.2g} % at n = {most}."


def body_introduction(benchmark: Benchmark) -> list[str]:
    """Paragraphs on what was measured, and how it counts."""
    case = benchmark.cases[0]
    config = case.config()
    return [
        f"Every controller meets the same crystals (test seeds), {config.horizon / HOUR:.3g} h each at "
        f"{config.control_interval:g} s control, on {case.grown_on}.",
        f"{INTERVALS} After a failure the radius error counts {config.radius_limit / MM:.3g} mm to "
        f"the end; drives, growth rate and ground-off are those of the time before it. {_none_lost(benchmark)} The "
        "verdict ranks by crystals lost (the lower end of the interval), then by cost, which counts radius error and "
        "moves. docs/controllers/bounds.md compares radius errors at equal pull steps, docs/benchmark.md has the "
        "protocol and every formula.",
        "RMSE of the true radius [mm] with 95 % interval and failures on each scenario, cost and moves on the first.",
    ]


# CzCrystal-v0: whole crystals, or stages of them.

CROWN = Column("crown_max_mm", "crown's largest error [mm]", 2)
CROWN_95 = Column("crown_max_mm", "95 % of crowns [mm]", 2, kind="quantile")
BODY = Column("body_within_half", "body within 0.5 mm [%]", 1, PERCENT)
V_OVER_G = Column("v_over_G_within_3pct", "v/G within 3 % [%]", 1, PERCENT)
TAIL_95 = Column("tail_max_mm", "95 % of tails [mm]", 2, kind="quantile")
ENERGY = Column("kwh_per_kg", "energy [kWh/kg]", 2)
HOURS = Column("hours", "time [h]", 2)
CRYSTAL_ERROR = (
    CROWN, CROWN_95, Column("body_rmse_mm", "body RMSE [mm]", 3), BODY, V_OVER_G,
    Column("v_over_G_within_10pct", "v/G within 10 % [%]", 1, PERCENT),
    Column("tail_max_mm", "tail's largest error [mm]", 2), TAIL_95, FAILURES,
)  # fmt: skip
CRYSTAL_DRIVES = (
    HOURS, ENERGY, Column("dopant_spread", "dopant's spread [%]", 1, PERCENT), PULL_STEP, HEATER_STEP, RMSE,
    COST, RETURN, Column(SPEED, "compute [us/step]", 2),
)  # fmt: skip
CRYSTAL_SHORT = tuple(
    column._replace(interval=False)
    for column in (FAILURES, CROWN, CROWN_95, BODY, V_OVER_G, TAIL_95, HOURS, ENERGY, PULL_STEP)
)
CRYSTAL_OVERVIEW = ((CROWN_95, 0), (BODY, 1), (V_OVER_G, 1), (TAIL_95, 2), (ENERGY, 1))
"""Columns of the overview, with the part of the crystal whose case they are taken from."""


def grows(benchmark: Benchmark, part: int) -> Case:
    """Return the first scenario whose stage is a part of the crystal, or the whole; else the first one."""
    return next((case for case in benchmark.cases if case.stage in (PARTS[part], "whole")), benchmark.cases[0])


def crystal_overview(benchmark: Benchmark) -> Groups:
    """Return heads, and rows by what contenders knew: losses on each case, then what counts in crown, body and tail."""
    groups: dict[str, list[tuple[str, ...]]] = {}
    for each in benchmark.contenders:
        failures = " / ".join(_plain(FAILURES, benchmark, case, each.name) for case in benchmark.cases)
        cells = (_plain(column, benchmark, grows(benchmark, part), each.name) for column, part in CRYSTAL_OVERVIEW)
        line = label(benchmark, benchmark.cases[0], each.name), failures, *cells
        groups.setdefault(each.knows, []).append(line)
    lost_on = f"lost of {' / '.join(case.name for case in benchmark.cases)} [%]"
    return ("controller", lost_on, *(column.heading for column, _ in CRYSTAL_OVERVIEW)), groups


def _plain(column: Column, benchmark: Benchmark, case: Case, name: str) -> str:
    return column._replace(interval=False).of(benchmark, case, name)


def crystal_verdict(benchmark: Benchmark, column: Column = RMSE) -> Verdict:
    """Say which controller that reads sensors ranks first: crystals lost, then cost (:meth:`Benchmark.rank`)."""
    able = [each.name for each in benchmark.contenders if not each.bound]
    if not able:
        return Verdict("No controller that reads sensors took part in this run.")
    if few := too_few(benchmark):
        return Verdict(few)
    crown, body = grows(benchmark, 0), grows(benchmark, 1)
    ranks = {name: benchmark.rank(benchmark.cases, name) for name in able}
    best = min(able, key=lambda name: ranks[name])
    fewest = [name for name in able if ranks[name][0] == ranks[best][0]]
    lost_of = ", ".join(f"{_plain(FAILURES, benchmark, case, best)} % of {case.name}" for case in benchmark.cases)
    crowns, bodies = _plain(CROWN_95, benchmark, crown, best), _plain(BODY, benchmark, body, best)
    who = f"{', '.join(fewest[:-1])} and {fewest[-1]} lose" if len(fewest) > 1 else f"{best} loses"
    said = [f"{who} the fewest crystals" + (f", {lost_of}" if len(fewest) == 1 else ", as far as the intervals tell")]
    said += [f"of them {best}, which loses {lost_of}, has the lowest cost"] if len(fewest) > 1 else []
    said += [f"95 % of its crowns are at most {crowns} mm off"] if crowns != NOTHING else []
    said += [f"{bodies} % of the body is within 0.5 mm"] if bodies != NOTHING else []
    return Verdict(f"{'; '.join(said)}.")


def crystal_losses(benchmark: Benchmark, case: Case) -> Table:
    """Return heads, and a row a contender: how many crystals it lost in each part, and how."""
    lines = []
    for name in (each.name for each in benchmark.contenders):
        cells = []
        for part in PARTS:
            where = benchmark.values(case, name, f"lost_in_{part}")
            counts = {way: int((where * benchmark.values(case, name, way)).sum()) for way in FAILURE_MODES}
            cells.append(", ".join(f"{number} {way}" for way, number in counts.items() if number) or NOTHING)
        lines.append((label(benchmark, case, name), *cells))
    return ("controller", *(f"lost in {part}" for part in PARTS)), lines


def crystal_introduction(benchmark: Benchmark) -> list[str]:
    """Paragraphs on what was measured of whole crystals, and how it counts."""
    case = benchmark.cases[0]
    return [
        f"Every controller meets the same whole crystals, or parts of them (test seeds), at {case.control_interval:g} "
        f"s control, on {case.grown_on}.",
        f"{INTERVALS} Errors are those of the true radius against the recipe's at the length grown; a crystal that is "
        f"lost in crown or tail has the largest allowed one there. What is said of the body is said of the length that "
        f"was grown. {_none_lost(benchmark)} docs/crystal.md explains every column.",
        "Losses on each stage; crown, body and tail where the stage grows them; energy is the body's, if there is one.",
    ]


# The records.


@dataclass(frozen=True)
class TaskRecord:
    """An environment as a benchmark runs and reports it."""

    environment: str
    name: str
    """Name of the folder of its committed results, and of the markers in pages that quote them."""
    cases: tuple[Case, ...]
    metrics: Any
    """Type of its metrics."""
    measure: Callable[[Rollout], Any]
    """Computes the metrics of a rollout."""
    columns: tuple[tuple[Column, ...], tuple[Column, ...]]
    """Columns of a scenario's tables: of the error, and of the drives."""
    short: tuple[Column, ...]
    """Columns on a terminal."""
    introduction: Callable[[Benchmark], list[str]]
    overview: Callable[[Benchmark], Groups]
    verdict: Callable[..., Verdict]
    panels: tuple[Panel, ...]
    losses: Callable[[Benchmark, Case], Table] | None = None
    """Table of the ways in which crystals were lost, if there are several."""
    by_length: bool = False
    """True if pictures show signals against the crystal's length, not against time."""
    quoted_rows: int = 8
    """Largest number of controllers in the table that pages quote."""
    has_bound: bool = True
    """True if gaps may be measured from the bound of an earlier run."""
    graded: bool = True
    """True if a report for a puller states scrap, outside a tolerance of the diameter."""

    def controllers(self) -> tuple[Contender, ...]:
        """Return its named controllers, in the order of tables."""
        return registry.KNOWN[self.environment]


TASKS = {
    each.environment: each
    for each in (
        TaskRecord(
            "Cz-v0",
            "benchmark",
            CASES,
            Metrics,
            metrics,
            (BODY_ERROR, BODY_DRIVES),
            BODY_SHORT,
            body_introduction,
            body_overview,
            body_verdict,
            PANELS,
        ),
        TaskRecord(
            "CzCrystal-v0",
            "crystal",
            CRYSTAL_CASES,
            CrystalMetrics,
            crystal_metrics,
            (CRYSTAL_ERROR, CRYSTAL_DRIVES),
            CRYSTAL_SHORT,
            crystal_introduction,
            crystal_overview,
            crystal_verdict,
            CRYSTAL_PANELS,
            losses=crystal_losses,
            by_length=True,
            quoted_rows=99,
            has_bound=False,
            graded=False,
        ),
    )
}
"""Task records by environment."""


def task_of(case: Case) -> TaskRecord:
    """Return the record of a scenario's environment; of ``Cz-v0`` for another process."""
    return TASKS.get(case.process.name, TASKS["Cz-v0"])


def contract_hash(cases: Sequence[Case]) -> str:
    """Hash what figures rest on: plant, scenarios, interval, horizon of the random cases; reward and metrics."""
    random = [case.config() for case in cases if not case.deterministic]
    configs = random or [case.config() for case in cases]
    parts = [*sorted(config.hash for config in configs), configs[0].reward_hash]
    parts += names_of(task_of(cases[0]).metrics)
    parts += [str(number) for number in (PULL_WINDOW, PULL_TOLERANCE, TOLERANCE, ALMOST)]
    return hashlib.sha256(" ".join(parts).encode()).hexdigest()[:12]
