"""Tables that pages take from the code, between ``<!-- table:NAME -->`` and ``<!-- table:end -->``.

``make tables`` writes them into the pages anew; a test compares.
"""

import json
import math
import re
from collections.abc import Callable, Iterable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

from cz_gym import SCENARIOS, Scenario
from cz_gym.baselines.margins import PLACES, worst_margins
from cz_gym.body.signals import INFO_ROWS
from cz_gym.camera.view import Camera
from cz_gym.config import make_config
from cz_gym.crystal.process import CRYSTAL
from cz_gym.episodes.scenario import FAMILIES
from cz_gym.episodes.scenarios import ALL, RANDOMIZED
from cz_gym.physics.parameters import MACHINE, Quantity, describe
from cz_gym.process import PULL_SCALE, Channel
from cz_gym.puller.file import DEFAULT, value_of
from cz_gym.spaces import HISTORY, LAGGED, LAGS, MEASURED, STATE
from cz_gym.support.units import MINUTE
from cz_gym.tools.registry import make_controller
from cz_gym.tools.serve.machine import OWN_TAGS, TAGS, Tag

from . import nomenclature, results

ABSENT = "\N{EN DASH}"
POWERS = str.maketrans("234", "²³⁴")
LOOPS = ("paper", "paper-tuned", "lqg-quiet", "lqg", "lqg-at-0.02", "lqg-one-design", "lqg-robust")


def markdown(head: Iterable[str], rows: Iterable[Iterable[str]]) -> list[str]:
    """A Markdown table; columns that hold nothing are left out."""
    columns = [column for column in zip(head, *rows, strict=True) if any(column[1:])]
    lines = [[cell.replace("|", r"\|") for cell in line] for line in zip(*columns, strict=True)]
    lines.insert(1, ["---"] * len(columns))
    return ["| " + " | ".join(line) + " |" for line in lines] + [""]


def code(text: str) -> str:
    """The text as code."""
    return f"`{text}`"


def units(text: str) -> str:
    """A unit with its powers raised: m/s2 as m/s²."""
    return re.sub(r"(?<=[A-Za-z])[234]", lambda power: power.group().translate(POWERS), text)


def channels(listed: Iterable[Channel]) -> list[str]:
    """A table of observation channels."""
    scales = {"v_p": "$v_0$", "v_p_mean": "$v_0 / 20$"}
    rows = []
    for i, c in enumerate(listed):
        rows.append((str(i), code(c.name), units(c.unit), scales.get(c.name, f"{c.scale:g}"), c.meaning))
    return markdown(("index", "name", "unit", "scale", "meaning"), rows)


def remembered() -> list[str]:
    """The channels of "history": the present ones, then where the spans of the past stand."""
    at = {channel.name: i for i, channel in enumerate(HISTORY)}
    heads, rows = ["ages of the samples"], []
    for name in LAGGED:
        c = HISTORY[at[f"{name}_{LAGS[0]:g}s"]]
        scale = f"{c.scale / PULL_SCALE:g} $v_0$" if name == "v_p" else f"{c.scale:g} {units(c.unit)}"
        heads.append(f"{code(name)} [{scale}]")
    for before, age in pairwise((0.0, *LAGS)):
        rows.append((f"{before:g} to {age:g} s", *(str(at[f"{name}_{age:g}s"]) for name in LAGGED)))
    present = channels(HISTORY[: at["integral"] + 1])
    return [*present, "Index and scale of each span's difference:", "", *markdown(heads, rows)]


def info() -> list[str]:
    """The keys of ``info``."""
    return markdown(("key", "unit", "meaning"), ((code(row.name), units(row.unit), row.meaning) for row in INFO_ROWS))


def readable(value: Any, quantity: Quantity) -> str:
    """A scenario's number, or range, in the unit that people read."""
    ends = value if isinstance(value, tuple) else (value, value)
    size, name = quantity.size, "" if quantity.shown == "1" else units(quantity.shown)
    if name == "s" and max(ends) >= 5 * MINUTE:
        size, name = MINUTE, "min"
    low, high = (f"{end / size:.4g}" if math.isfinite(end) else "∞" for end in ends)
    between = f"±{high}" if low == f"-{high}" else low if low == high else f"{low} to {high}"
    return f"{between} {name}".strip()


def scenario_table(columns: list[Scenario]) -> list[str]:
    """Scenarios as columns, one line for each number in which any of them departs from the default."""
    rows = []
    for members in zip(*(scenario.members for scenario in columns), strict=True):
        family, each, _ = members[0]
        quantity, cells = each.metadata["member"].quantity, [value for _, _, value in members]
        if any(cell != each.default for cell in cells):
            written = [ABSENT if cell == each.default else readable(cell, quantity) for cell in cells]
            rows.append((f"{code(f'{family}.{each.name}')} {quantity.meaning}", *written))
    return markdown(("", *(code(scenario.name) for scenario in columns)), rows)


def single_scenarios() -> list[str]:
    """The scenarios with one of randomized's families, and which it is."""
    pairs = ((name, _single(scenario)) for name, scenario in SCENARIOS.items())
    return markdown(("scenario", "family"), [(code(name), code(family)) for name, family in pairs if family])


def _single(scenario: Scenario) -> str | None:
    """The one family of a scenario, if it is as in randomized."""
    names = [name for name, kind in FAMILIES.items() if getattr(scenario, name) != kind()]
    alone = len(names) == 1 and getattr(scenario, names[0]) == getattr(RANDOMIZED, names[0])
    return names[0] if alone else None


def families() -> list[str]:
    """Every member of every family, with unit and default."""
    rows = []
    for family, each, value in Scenario("plain").members:
        quantity, name = each.metadata["member"].quantity, f"{FAMILIES[family].__name__}.{each.name}"
        shown = f"({value[0]:g}, {value[1]:g})" if isinstance(value, tuple) else f"{value:g}"
        rows.append((code(name), units(quantity.unit), shown, quantity.meaning))
    return markdown(("member", "unit", "default", "meaning"), rows)


def symbols(part: str) -> list[str]:
    """A part of the nomenclature."""
    rows = []
    for row in nomenclature.ROWS[part]():
        where = ", ".join(f"[({n})](physics.md#eq-{n})" for n in row.equations) or ABSENT
        rows.append((f"${row.symbol}$", code(row.code), row.value, units(row.unit), row.meaning, where, row.source))
    return markdown(("symbol", "code", "value", "unit", "meaning", "equation", "source"), rows)


def puller() -> list[str]:
    """The keys of a puller file."""
    rows = []
    for each in MACHINE.values():
        value = value_of(DEFAULT, each)
        default = "the scenario's" if value is None else f"{value / each.size:.10g}"
        pair, limits = "number or pair" if each.drawn else "", f"{each.low:g} to {each.high:g}"
        rows.append((code(f"[{each.table}]"), code(each.key), default, limits, pair, each.meaning))
    return markdown(("table", "key", "default", "range", "", "meaning"), rows)


def camera() -> list[str]:
    """The camera's parameters."""
    rows = []
    for name, q in describe(Camera).items():
        rows.append((code(name), f"{getattr(Camera(), name):.6g}", units(q.unit), q.meaning, q.source))
    return markdown(("code", "value", "unit", "meaning", "source"), rows)


def exported() -> list[str]:
    """Findings of the study of exported C: each controller's largest difference of an action, and rows that differ."""
    by_name: dict[tuple[str, str], list[Any]] = {}
    for row in json.loads((DOCS.parent / "results" / "export" / "export.json").read_text())["rows"]:
        by_name.setdefault((code(row["controller"]), row["real"]), []).append(row)
    rows = []
    for names, of in by_name.items():
        differ = f"{sum(row['python'] != row['c'] for row in of)} of {len(of)}"
        rows.append((*names, f"{max(row['difference'] for row in of):.1e}", differ))
    return markdown(("controller", "C", "largest difference of an action", "rows of the table that differ"), rows)


def margins() -> list[str]:
    """Margins of controllers' loops at each opening, on ``randomized``."""
    config = make_config(RANDOMIZED, None, "measured", action="direct")
    loops = [worst_margins(make_controller(name, config), config) for name in LOOPS]
    gains, times = ("gain may grow by", "gain may fall to"), ("phase margin [degrees]", "may be late by [s]")
    words = *gains, *times, "peak of the sensitivity"
    rows = []
    for place, of in zip(PLACES, zip(*loops, strict=True), strict=True):
        for what, values in zip(words, zip(*of, strict=True), strict=True):
            shown = (f"{value:.0f}" if value >= 10.0 else f"{value:.2g}" if value else ABSENT for value in values)
            rows.append((f"{place}: {what}", *shown))
    return results.table(("", *map(code, LOOPS)), rows)


def tags(listed: tuple[Tag, ...]) -> list[str]:
    """Tags of the virtual puller."""
    return markdown(("tag", "type", "meaning"), ((code(t.name), t.kind.__name__, t.meaning) for t in listed))


TABLES: dict[str, Callable[[], list[str]]] = {
    "measured": lambda: channels(MEASURED),
    "history": remembered,
    "state": lambda: channels(STATE),
    "info": info,
    "crystal-measured": lambda: channels(CRYSTAL.measured),
    "scenarios": lambda: scenario_table([s for s in SCENARIOS.values() if s in ALL.scenarios]),
    "plain-scenarios": lambda: scenario_table([s for s in SCENARIOS.values() if s.deterministic]),
    "single-scenarios": single_scenarios,
    "families": families,
    "camera": camera,
    "exported": exported,
    "margins": margins,
    "tags": partial(tags, TAGS),
    "crystal-tags": partial(tags, OWN_TAGS),
    "puller": puller,
    **{part: partial(symbols, part) for part in nomenclature.ROWS},
    **results.TABLES,
}
"""Every table, by the name a page asks for it with."""


DOCS = Path(__file__).parents[1]
CONTENTS = DOCS / "_contents.md"
"""The site's contents. Each part stands behind the page that it names: GitHub would show it as code there."""
_BETWEEN = re.compile(r"(?<=<!-- table:)(?!end)([\w-]+)( -->\n).*?(?=<!-- table:end -->)", re.DOTALL)
_BEHIND = re.compile(r"^<!-- behind (\S+) -->\n", re.MULTILINE)
_EQUATION = re.compile(r"\[(\(\d+\))\]\(physics\.md(#eq-\d+)\)")


def filled(page: str) -> str:
    """A page with its tables as the code has them."""
    return _BETWEEN.sub(lambda found: f"{found[1]}{found[2]}" + "\n".join(TABLES[found[1]]()), page)


def contents() -> dict[str, str]:
    """Lists of further pages, by the page that they stand behind."""
    _, *parts = _BEHIND.split(CONTENTS.read_text())
    return dict(zip(parts[::2], parts[1::2], strict=True))


def read(app: Any, name: str, source: list[str]) -> None:
    """Replace a page's text for the site: its contents behind it, links to equations as anchors."""
    source[0] += contents().get(name, "")
    source[0] = _EQUATION.sub(r'<a href="physics.html\2">\1</a>', source[0])


def setup(app: Any) -> dict[str, bool]:
    """Listen to what is read."""
    app.connect("source-read", read)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


if __name__ == "__main__":
    for path in DOCS.rglob("*.md"):
        path.write_text(filled(path.read_text()))
