"""``report.html``: the benchmark as one page that opens from disk, and fetches nothing: tables, vector pictures, and a
player of one crystal of each scenario under any two controllers.

Names come from agent files and are untrusted: they are escaped for HTML, and as data for the page's script.
"""

import json
import re
from collections.abc import Iterable
from html import escape
from importlib.resources import files
from typing import Any

import numpy as np

from cz_gym.env import CzEnv
from cz_gym.evaluation.plots import DRIVE, INK, RING, TRUE, lighter
from cz_gym.evaluation.protocol import REFERENCE, Case
from cz_gym.evaluation.rollout import Floats
from cz_gym.support.units import HOUR, MINUTE, MM
from cz_gym.tools.episodes import Benchmark
from cz_gym.tools.posterior import explained
from cz_gym.tools.report.task_records import task_of

from . import markdown, tables, vector
from .figures import lost
from .markdown import measured_from
from .tables import RMSE, in_player, typical

POINT, POINTS = 45.0, 400
"""Time over which a point of a line is the mean at least [s], and most points of a line."""
OUTLIERS = 0.001
"""Share of the values at either end that may lie outside a panel's range [-]."""
DIGITS = 3
"""Decimals of the values in the page."""
COLOURS = {"true": TRUE, "camera": RING, "recipe": INK, "drive": DRIVE}
"""Colours of lines; drives have one of their own."""


def crystals(benchmark: Benchmark) -> list[dict[str, Any]]:
    """Return the :func:`.typical` crystal of each scenario of those of :func:`.in_player`.

    Each panel's lines are means over some seconds, up to the first value that is no number, in the panel's unit.
    """
    return [_crystal(benchmark, case) for case in benchmark.cases]


def _crystal(benchmark: Benchmark, case: Case) -> dict[str, Any]:
    task, number = task_of(case), typical(benchmark, case)
    seed = benchmark.seeds(case)[number]
    names = [each.name for each in in_player(benchmark, case)]
    signals = {name: benchmark.signals[case.name, name] for name in names}
    longest = max(len(each.r_c) for each in signals.values())
    step = max(round(POINT / case.control_interval), -(-longest // POINTS), 1)
    bias = ring_bias(case, seed)
    runs: list[dict[str, Any]] = []
    for name, logged in signals.items():
        lines = {
            f"{panel.title}/{line}": _points(signal(logged, bias) / panel.scale, step)
            for panel in task.panels for line, signal in panel.lines.items()
        }  # fmt: skip
        rmse = float(benchmark.values(case, name, RMSE.metric)[0, number])
        runs.append({"name": name, "lost": lost(benchmark, case, name), "rmse": round(rmse, DIGITS), "lines": lines})
    whole = [run for run in runs if not run["lost"]] or runs
    panels = []
    for panel in task.panels:
        values = [value for run in whole for line in panel.lines for value in run["lines"][f"{panel.title}/{line}"]]
        low, high = np.quantile([*values, *panel.levels] or [0.0], (OUTLIERS, 1.0 - OUTLIERS))
        margin = max(0.08 * (high - low), 1e-3)
        ends = [round(float(low - margin), DIGITS), round(float(high + margin), DIGITS)]
        panels.append({"title": panel.title, "unit": panel.unit, "lines": [*panel.lines], "ends": ends})
    minutes = step * case.control_interval / MINUTE
    return {"case": case.name, "seed": seed, "minutes": minutes, "panels": panels, "runs": runs}


def _points(values: Floats, step: int) -> list[float]:
    """Means over ``step`` steps each, up to the first value that is no number: a crystal that broke the equations."""
    steps = int(np.isfinite(values).cumprod().sum())
    means = values[: steps // step * step].reshape(-1, step).mean(axis=1)
    return [round(float(value), DIGITS) for value in means]


def ring_bias(case: Case, seed: int) -> float:
    """Return the operator's bias of a seed's puller [m]: bright ring less radius at its own steady state.

    Zero for a whole crystal, which has no steady state.
    """
    if task_of(case).by_length:
        return 0.0
    env = CzEnv.from_config(case.config())
    env.reset(seed=seed)
    return float(env.get_state().slot.slot["puller"]["ring_bias"])


BEST_NOTE = (
    "The paper's controller, of each kind the one that ranks first over these scenarios (crystals lost, then cost), "
    "and your own: RMSE [mm] on each. Cost and drives are those on the first."
)
ANSWER_NOTE = (
    "Mean cost a step, which counts radius error and moves; the difference is learned less classical, and is shown if "
    "its 95&nbsp;% interval, on the same crystals, leaves out zero. Crystals lost rank before cost, by the lower end "
    "of their interval."
)
_SLOT = re.compile(r"<!-- slot:(\w+) -->")


def page(benchmark: Benchmark, command: str) -> str:
    """Return the page; the same results give the same text."""
    case, contenders, task = benchmark.cases[0], benchmark.contenders, task_of(benchmark.cases[0])
    verdict, config = task.verdict(benchmark), case.config()
    most = max(len(benchmark.seeds(each)) for each in benchmark.cases)
    best = tables.best_of_each_kind(benchmark)
    shown = [each for each in contenders if each in best or each.name == REFERENCE]
    heads, groups = task.overview(benchmark.only(tables.deciding(benchmark), shown))
    light, dark = (
        "".join(f".{name}{{color:{shade(colour)}}}" for name, colour in COLOURS.items()) for shade in (str, lighter)
    )
    colours = f"{light}@media screen and (prefers-color-scheme:dark){{{dark}.recipe{{color:#fff}}}}"
    parts = {
        "style": _asset("page.css") + colours + vector.STYLE,
        "script": _asset("player.js"),
        "data": json.dumps(crystals(benchmark), separators=(",", ":")).replace("<", "\\u003c"),
        "verdict": escape(verdict.sentence),
        "finding": escape(re.sub(r"[`*]", "", markdown.finding(benchmark))),
        "best": _table(heads, [(f"{name} [{kind}]", *cells) for kind, rows in groups.items() for name, *cells in rows]),
        "best_note": BEST_NOTE,
        "question": "Who ranks first where",
        "answer_note": ANSWER_NOTE,
        "limit": f"{config.radius_limit / MM:.3g}",
        "lede": f"{tables.count(len(contenders), 'controller')}, {tables.count(len(benchmark.cases), 'scenario')}, "
        f"up to {tables.crystals(most)} each, the same for everyone: at most {config.horizon / HOUR:.3g} h at one "
        f"action every {config.control_interval:g} s, on {case.grown_on}.",
        "scenarios": _table(verdict.heads, verdict.rows) if verdict.rows else "",
        "tables": "\n".join(_metrics(benchmark, each, is_open=each is case) for each in benchmark.cases),
        "result": vector.result(benchmark),
        "pareto": vector.pareto(benchmark),
        "controllers": _table(*tables.who(benchmark), "words")
        + (f'<p class="note">{escape(tables.ROBUSTNESS_MEANS)}</p>' if benchmark.robustness else ""),
        "command": escape(command),
    }
    if case.tolerance is not None:
        parts |= _for_a_grower(benchmark)
    return _SLOT.sub(lambda slot: parts[slot[1]], _asset("page.html"))


def _for_a_grower(benchmark: Benchmark) -> dict[str, str]:
    """The parts of the page that differ on a puller."""
    tables_of = (
        f"<h3>{escape(case.name)}</h3>{_table(*markdown.outcome(benchmark, case))}" for case in benchmark.cases
    )
    return {
        "verdict": escape(markdown.recommendation(benchmark)),
        "best": f"<h2>{escape(markdown.title(benchmark.cases[0]))}</h2>{''.join(tables_of)}",
        "best_note": escape(" ".join((markdown.EXPLAINED, *markdown.warnings(benchmark)))),
        "question": "What the loops bear",
        "scenarios": _table(markdown.MARGINS, markdown.margins(benchmark)),
        "answer_note": escape(explained(benchmark.cases[0].puller)),
    }


def _metrics(benchmark: Benchmark, case: Case, is_open: bool) -> str:
    """Every metric of a scenario, crystals lost and then the lowest cost first, to unfold."""
    error, drives = task_of(case).columns
    columns = (*error, *tables.comparison(benchmark, case), *drives)
    ranked = sorted(benchmark.contenders, key=lambda each: benchmark.rank([case], each.name))
    heads = "controller", *(column.heading for column in columns)
    rows = tables.rows(benchmark.only(contenders=ranked), case, columns)
    marks = (" [bound]" * each.bound for each in ranked)
    marked = [(f"{name}{mark}", *cells) for mark, (name, *cells) in zip(marks, rows, strict=True)]
    about = escape(f"{case.meaning}. {measured_from(benchmark, case).replace('`', '')}")
    return (
        f"<details{' open' if is_open else ''}><summary>{escape(case.name)} "
        f'({tables.crystals(len(benchmark.seeds(case)))})</summary><p class="note">{about}</p>'
        f"{_table(heads, marked)}</details>"
    )


def _table(heads: Iterable[str], rows: Iterable[Iterable[str]], kind: str = "figures") -> str:
    """A table that scrolls sideways in its own frame; what stands in brackets stands below, small."""
    lines = "\n".join(
        f"<tr>{_cell('th', name)}{''.join(_cell('td', cell) for cell in cells)}</tr>" for name, *cells in rows
    )
    return (
        f'<div class="scroll" tabindex="0"><table class="{kind}">\n'
        f"<thead><tr>{''.join(_cell('th', head) for head in heads)}</tr></thead>\n"
        f"<tbody>\n{lines}\n</tbody></table></div>"
    )


def _cell(tag: str, text: str) -> str:
    first, _, below = text.partition(" [")
    return f"<{tag}>{escape(first)}{f'<small>[{escape(below)}</small>' if below else ''}</{tag}>"


def _asset(name: str) -> str:
    return files(__package__).joinpath("html", name).read_text("utf-8")
