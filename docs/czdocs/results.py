"""Tables that pages take from committed results and from the records of searches."""

import json
from collections.abc import Callable, Iterable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

from cz_gym.baselines.tuned_controllers import FAMILY
from cz_gym.evaluation.statistics import ratios
from cz_gym.tools.report.tables import markdown

ROOT = Path(__file__).parents[2]
RECORDS = ROOT / "cz_gym" / "puller" / "shipped" / "default"
SCENARIOS = ("randomized", "hard", "sensor-fault", "puller", "hot-zone")
OBSERVABLE = ("sensor-fault", "puller")
"""Scenarios whose true radius error holds an offset of the ring, which no sensor shows."""
STEP = "pull_step_rms_mm_per_min"
PIDS = ("paper", "paper-filtered", "paper-tuned", "pid-conventional")
LQGS = ("lqg", "lqg-quiet", "lqg-at-0.02", "lqg-at-0.02-adaptive", "lqg-one-design")
CRYSTALS = ("ring-pid-reduced", "compensated", "lqg-along", "true-radius")
PULLERS = ("silicon-300mm", "germanium")
BOUNDS = ("lqg", "lqg-quiet", "lqg-true", "full-information", "clairvoyant")
BUDGETS = tuple(f"{name}-{budget}M" for budget in (1, 5, 20) for name in ("ppo-plain", "ppo"))
MEMBERS = ("0.005", "0.008", "0.013", "0.02", "0.03")
"""Frontier of the LQG: largest pull step RMS of each member [mm/min]."""
METRICS = (
    ("rmse_observable_mm", "observable RMSE [mm]", "{:.3f}"),
    (STEP, "pull step RMS [mm/min]", "{:.4f}"),
    ("mean_pull_within_3pct", "30 min mean pull within 3 % [share]", "{:.2f}"),
    ("cost", "cost", "{:.4f}"),
    ("failure_rate", "crystals lost [share]", "{:.3f}"),
)
"""Rows of a table of figures: metric, its words, its format."""
WHOLE = (
    ("failure_rate", "crystals lost [share]", "{:.3f}"),
    ("crown_max_mm", "largest error of the crown, mean [mm]", "{:.2f}"),
    ("body_rmse_mm", "RMSE of the body [mm]", "{:.3f}"),
    ("body_within_half", "body within 0.5 mm [share]", "{:.3f}"),
    ("v_over_G_within_3pct", "v/G within 3 % [share]", "{:.2f}"),
    ("tail_max_mm", "largest error of the tail, mean [mm]", "{:.2f}"),
    ("kwh_per_kg", "heater's energy [kWh/kg]", "{:.2f}"),
)
"""The same of whole crystals."""
CASES = ("puller-frames", "melt-layer", "randomized-traced")
"""Cases on request whose plant or ring no agent has met, and no controller is told."""
COSTS = tuple(row for row in METRICS if row[0] in ("cost", "failure_rate"))
Lines = list[str]


@cache
def run(name: str) -> Any:
    """A committed run of the benchmark."""
    return json.loads((ROOT / "results" / name / "benchmark.json").read_text())


def figures(
    name: str, controllers: Sequence[str], scenarios: Sequence[str] = SCENARIOS, metrics: Any = METRICS
) -> Lines:  # fmt: skip
    """Means of a run: a column a controller, a row a scenario and metric."""
    rows = []
    for scenario in scenarios:
        of = run(name)["results"].get(scenario, {})
        for metric, words, shown in metrics:
            cells = [shown.format(of[each][metric]["mean"]) if each in of else "-" for each in controllers]
            rows.append((f"{scenario}: {words}", *cells))
    return table(("", *map(code, controllers)), rows)


def gaps() -> Lines:
    """Optimality gaps of the bounds' run [%]."""
    rows = []
    for key, words in (("optimality_gap", "cost"), ("optimality_gap_radius", "squared radius error")):
        of = run("bounds")[key]
        for each in ("lqg", "lqg-quiet", "lqg-true", "full-information"):
            cells = [(of[s][each]["mean"], *of[s][each]["ci95"]) for s in of]
            rows.append(
                (f"{words}: {code(each)}", *("{:.2f} [{:.2f}, {:.2f}]".format(*(100 * x for x in c)) for c in cells))
            )
    return table(("gap [%]", *of), rows)


def equal() -> Lines:
    """Radius errors over the LQG's at equal pull steps, in the frontier's run."""
    of, columns = run("frontier")["results"], []
    for scenario in of:
        metric = "rmse_observable_mm" if scenario in OBSERVABLE else "rmse_mm"
        points = {name: (means[STEP]["mean"], means[metric]["mean"]) for name, means in of[scenario].items()}
        columns.append(ratios(points, FAMILY))
    names = [name for name in of[SCENARIOS[0]] if name not in FAMILY]
    rows = ((code(name), *(f"{each[name]:.3f}" if name in each else "-" for each in columns)) for name in names)
    return table(("", *(f"{each}, observable" if each in OBSERVABLE else each for each in of)), rows)


def frontier() -> Lines:
    """Figures with which the frontier's members were chosen, on validation crystals."""
    rows = []
    for scenario in SCENARIOS[:-1]:
        own = "" if scenario == "randomized" else f"-{scenario}"
        chosen = [record(f"lqg-at-{size}{own}")["chosen"]["figures"] for size in MEMBERS]
        for metric, words, shown in (
            ("pull_step", "pull step RMS [mm/min]", "{:.4f}"),
            ("rmse_mm", "RMSE [mm]", "{:.3f}"),
        ):
            rows.append((f"{scenario}: {words}", *(shown.format(each[metric]) for each in chosen)))
    return table(("", *(code(f"lqg-at-{size}") for size in MEMBERS)), rows)


def on_pullers() -> Lines:
    """Whole crystals of other pullers: lost ones of each stage, and the crown's largest error."""
    rows = []
    for puller in PULLERS:
        of = run(f"crystal-{puller}")["results"]
        for stage in of:
            lost = (of[stage][each]["failure_rate"]["mean"] for each in CRYSTALS)
            rows.append((f"{puller}: {stage}, lost [%]", *(f"{100.0 * share:.0f}" for share in lost)))
        errors = (of["crown"][each]["crown_max_mm"]["mean"] for each in CRYSTALS)
        rows.append((f"{puller}: largest error of the crown, mean [mm]", *(f"{error:.2f}" for error in errors)))
    return table(("", *map(code, CRYSTALS)), rows)


def searches(*controllers: str) -> Lines:
    """Budgets of the searches whose records ship: candidates and training crystals."""
    rows: dict[tuple[str, str, str], list[str]] = {}
    names = (path.stem for path in sorted(RECORDS.glob("*.json")) if path.name.startswith(controllers))
    for found in map(record, names):
        budget = (found["scenario"], str(found["budget"]["trials"]), str(found["budget"]["episodes"]))
        rows.setdefault(budget, []).append(code(found["controller"]))
    lines = ((", ".join(names), *budget) for budget, names in sorted(rows.items()))
    return table(("searches", "crystals of", "candidates", "training crystals"), lines)


def rows_of(path: str) -> list[list[str]]:
    """The rows of a committed table, its headings first."""
    lines = [line for line in (ROOT / "results" / path).read_text().splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if not line.startswith("|-")]


def copied(*paths: str) -> Lines:
    """Committed tables with the same heads, one below the other."""
    head = rows_of(paths[0])[0]
    return table(head, [row for path in paths for row in rows_of(path)[1:]])


def faults() -> Lines:
    """Radius error and lost crystals of each block under each fault."""
    cells: dict[str, dict[str, tuple[str, str]]] = {}
    for controller, fault, error, _, lost, *_ in rows_of("faults/report.md")[1:]:
        cells.setdefault(fault, {})[controller] = error, lost
    controllers = dict.fromkeys(name for row in cells.values() for name in row)
    head = [each for name in controllers for each in (f"{code(name)} [mm]", "lost")]
    rows = ([each for name in controllers for each in row.get(name, ("-", "-"))] for row in cells.values())
    return table(("fault", *head), ((fault, *row) for fault, row in zip(cells, rows, strict=True)))


def record(name: str) -> Any:
    """The record of a shipped search."""
    return json.loads((RECORDS / f"{name}.json").read_text())


def code(text: str) -> str:
    """The text as code."""
    return f"`{text}`"


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> Lines:
    """A table of numbers as a page holds it."""
    return [*markdown(tuple(head), [tuple(row) for row in rows]).splitlines(), ""]


TABLES: dict[str, Callable[[], Lines]] = {
    "figures-pid": partial(figures, "benchmark", PIDS),
    "figures-lqg": partial(figures, "benchmark", LQGS),
    "figures-budgets": partial(figures, "budgets", BUDGETS, ("randomized", "puller")),
    "figures-cases": partial(
        figures, "cases", ("paper-tuned", "lqg", "lqg-at-0.02", "gradient", "ppo", "sac"), CASES, COSTS
    ),
    "figures-bounds": partial(figures, "bounds", BOUNDS, SCENARIOS[:-1]),
    "faults": faults,
    "gaps": gaps,
    "ratios": equal,
    "frontier": frontier,
    "whole": partial(figures, "whole", ("compensated", "lqg-along", "gradient-along"), ("whole",), WHOLE),
    "stock": partial(copied, "stock/table.md"),
    "offline": partial(copied, "offline/lqg-mixed.txt", "offline/operator-paper.txt"),
    "on-pullers": on_pullers,
    "sensors": partial(copied, "sensors/table.md"),
    "searches-crystal": partial(searches, "compensated", "lqg-along", "ring-pid-reduced"),
    "searches-lqg": partial(searches, "lqg-at", "lqg-quiet", "lqg.", "lqg-one", "lqg-puller", "lqg-sensor"),
    "searches-pid": partial(searches, *PIDS),
}
"""Every table, by the name a page asks for it with."""
