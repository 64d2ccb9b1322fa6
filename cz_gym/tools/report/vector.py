"""Vector pictures of a benchmark: the result in one look, and error against pull activity.

They are SVG, with text that can be searched and colours that follow the reader's light or dark ground.
"""

import math
from collections.abc import Iterable, Sequence
from html import escape
from typing import NamedTuple

from cz_gym.evaluation.plots import COLOURS, MARKS, Style, lighter
from cz_gym.evaluation.protocol import Case, Contender
from cz_gym.evaluation.statistics import Estimate
from cz_gym.puller.file import DEFAULT
from cz_gym.tools.episodes import Benchmark

from .tables import FAILURES, PIDS, PULL_STEP, RMSE, deciding, in_one_look, looks_of

WIDTH = 640.0
"""Width of a picture [px]: its words can be read on a phone too, where it is drawn at about half of that."""
FAR = 30.0
"""Values beyond this multiple of the least one stand at an axis's end, with their number [-]."""
LONGEST = 20
"""Longest name that there is room for [characters]."""
PLAIN = {
    "randomized": "randomized (usual)", "paper": "paper (PID)", "paper-tuned": "paper-tuned (PID)",
    "paper-filtered": "paper-filtered (PID)",
}  # fmt: skip
"""Scenarios and controllers whose names do not say what they are."""
OFTEN = 0.05
"""Share of crystals lost above which a row of the result says it [-]."""
STYLE = "\n".join(
    (
        ".cz{font:18px system-ui,'Segoe UI',Roboto,'Helvetica Neue','Liberation Sans',Arial,sans-serif}"
        ".cz text{fill:#1b1f24}.cz .faint{fill:#5a626c}.cz .back{fill:#fff}"
        ".cz .grid{stroke:#e1e5ea;fill:none}.cz .axis{stroke:#5a626c;fill:none}",
        "".join(f".c{number}{{color:{colour}}}" for number, colour in enumerate(COLOURS)),
        "@media screen and (prefers-color-scheme:dark){"
        ".cz text{fill:#e6e9ee}.cz .faint{fill:#a4adb9}.cz .back{fill:#0d1117}"
        ".cz .grid{stroke:#2a323d}.cz .axis{stroke:#a4adb9}"
        + "".join(f".c{number}{{color:{lighter(colour)}}}" for number, colour in enumerate(COLOURS))
        + "}",
    )
)
"""Style of every picture; class ``c0`` and so on have the colours of controllers."""


class Axis(NamedTuple):
    """A logarithmic axis between two pixels."""

    low: float
    high: float
    start: float
    end: float

    @classmethod
    def around(cls, values: Iterable[float], start: float, end: float) -> "Axis":
        """Return the axis of these values, those beyond :data:`FAR` times the least left out."""
        positive = sorted(value for value in values if 0.0 < value < math.inf) or [1.0]
        near = [value for value in positive if value <= FAR * positive[0]]
        return cls(near[0] / 1.15, near[-1] * 1.15, start, end)

    def at(self, value: float) -> float:
        """Return the pixel of a value, of an end for one beyond it."""
        inside = min(max(value, self.low), self.high)
        return self.start + (self.end - self.start) * math.log(inside / self.low) / math.log(self.high / self.low)

    def holds(self, value: float) -> bool:
        """Return whether the axis reaches a value."""
        return self.low <= value <= self.high

    @property
    def ticks(self) -> list[float]:
        """Numbers 1, 2 and 5 times powers of ten within the axis."""
        powers = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
        return [value for power in powers for value in (1e0 * 10**power, 2e0 * 10**power, 5e0 * 10**power)
                if self.holds(value)]  # fmt: skip


def svg(height: float, parts: Iterable[str], title: str) -> str:
    """Return a picture of :data:`WIDTH` and this height [px], with its title for those who do not see it."""
    size = f'width="{WIDTH:g}" height="{height:g}" viewBox="0 0 {WIDTH:g} {height:g}"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" class="cz" {size} role="img">'
    ground = f'<rect class="back" width="{WIDTH:g}" height="{height:g}"/>'
    return "\n".join((head, f"<title>{escape(title)}</title>", ground, *parts, "</svg>")) + "\n"


def as_file(picture: str) -> bytes:
    """Return a picture as a file of its own, which holds its style."""
    return picture.replace("<title>", f"<style>{STYLE}</style>\n<title>", 1).encode()


def text(x: float, y: float, words: str, anchor: str = "start", **look: str) -> str:
    """Return words at a place, their anchor "start", "middle" or "end"."""
    more = "".join(f' {name.rstrip("_").replace("_", "-")}="{value}"' for name, value in look.items())
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"{more}>{escape(words)}</text>'


def line(x_1: float, y_1: float, x_2: float, y_2: float, kind: str, width: float = 1.0) -> str:
    """Return a line of a class between two points."""
    path = f"M{x_1:.1f} {y_1:.1f}L{x_2:.1f} {y_2:.1f}"
    return f'<path class="{kind}" stroke-width="{width:g}" d="{path}"/>'


def mark(x: float, y: float, look: Style, hollow: bool, size: float = 8.0) -> str:
    """Return a controller's mark, hollow for one that is told the scenario."""
    points = " ".join(f"{x + size * across:.1f},{y - size * up:.1f}" for across, up in MARKS[look.mark])
    fill = 'class="back"' if hollow else 'fill="currentColor"'
    outline = 'stroke="currentColor" stroke-width="2.4" stroke-linejoin="round"'
    return f'<g {_coloured(look)}><polygon {fill} {outline} points="{points}"/></g>'


def _coloured(look: Style) -> str:
    return f'class="c{COLOURS.index(look.colour)}"'


def bar(x_1: float, y_1: float, x_2: float, y_2: float, look: Style) -> str:
    """Return an interval in a controller's colour."""
    path = f"M{x_1:.1f} {y_1:.1f}L{x_2:.1f} {y_2:.1f}"
    return f'<path {_coloured(look)} stroke="currentColor" stroke-width="4" stroke-opacity="0.5" d="{path}"/>'


def is_told(each: Contender, case: Case) -> bool:
    """Return whether a controller has settings for this scenario, or knows more; on a user's puller none is tuned."""
    return each.bound or (each.told and case.puller.label == DEFAULT.label)


def short(name: str) -> str:
    """Return a name as a picture has room for it."""
    shown = "".join(letter if letter.isprintable() else " " for letter in name)
    return shown if len(shown) <= LONGEST else f"{shown[: LONGEST - 1]}…"


# The result in one look.

LABELS, ROW, TOP = 208.0, 31.0, 68.0
"""Width of the names, height of a row, and of what stands above the rows [px]."""


def result(benchmark: Benchmark) -> str:
    """Draw controllers as rows, their mean RMSE and its interval on a logarithmic axis, in the first two scenarios."""
    cases = deciding(benchmark)[:2]
    shown = in_one_look(benchmark, PIDS)
    looks = looks_of(benchmark)
    known = {(case.name, each.name): benchmark.get(case, each.name, RMSE.metric) for case in cases for each in shown}
    there = [found for found in known.values() if found]
    reached = [value for found in there for value in (found.mean, *found.ends)]
    room = (WIDTH - LABELS - 12.0) / len(cases)
    bottom = TOP + ROW * len(shown)
    parts = [text(12.0, 26.0, "Error of the radius, RMSE [mm]: further left is better", font_weight="bold")]
    for number, case in enumerate(cases):
        left = LABELS + number * room
        axis = Axis.around(reached, left + 14.0, left + room - 14.0)
        head = text(axis.start, TOP - 12.0, PLAIN.get(case.name, case.name), class_="faint", font_size="17")
        parts += [head, *_scale(axis, TOP, bottom)]
        for row, each in enumerate(shown):
            share = benchmark.get(case, each.name, FAILURES.metric)
            parts += _row(
                axis, TOP + (row + 0.5) * ROW, known[case.name, each.name], share, looks[each.name], is_told(each, case)
            )
    for row, each in enumerate(shown):
        name = PLAIN.get(each.name, each.name)
        parts += [text(LABELS - 4.0, TOP + (row + 0.5) * ROW + 5.5, short(name), "end")]
    below, height = _below(shown, cases[0], max((found.n for found in there), default=0), bottom)
    return svg(height, parts + below, "Radius error of each controller: " + _spoken(known))


def _below(shown: Sequence[Contender], case: Case, crystals: int, y: float) -> tuple[list[str], float]:
    """Key and notes below the rows, which end at y [px], and the height of the picture [px]."""
    told = "its scenario, tuned for it" if any(each.told for each in shown) else "what no sensor shows"
    hollow = any(is_told(each, case) for each in shown)
    notes = ["mean of all crystals, lost ones included", "ranks go by crystals lost, then by cost"]
    notes += [f"bars: 95 % intervals over {crystals} test crystals"] if crystals > 1 else []
    top = y + 84.0 + 28.0 * hollow
    parts = _key(y + 52.0, f"hollow: told {told}" if hollow else "", any(each.learned for each in shown))
    parts += [text(12.0, top + 26.0 * row, note, class_="faint") for row, note in enumerate(notes)]
    return parts, top - 10.0 + 26.0 * len(notes)


def _spoken(known: dict[tuple[str, str], Estimate | None]) -> str:
    return ", ".join(f"{name} {found.mean:.3f} mm on {case}" for (case, name), found in known.items() if found)


def _scale(axis: Axis, top: float, bottom: float) -> list[str]:
    """The lines of an axis across, and its numbers below."""
    parts = [line(axis.start, bottom, axis.end, bottom, "axis")]
    for value in axis.ticks:
        parts += [line(axis.at(value), top, axis.at(value), bottom, "grid")]
        parts += [text(axis.at(value), bottom + 20.0, f"{value:g}", "middle", class_="faint", font_size="16")]
    return parts


def _row(axis: Axis, y: float, found: Estimate | None, share: Estimate | None, look: Style, told: bool) -> list[str]:
    """A controller's line, with its mark and interval, or its number and share lost where the axis does not reach."""
    parts = [line(axis.start, y, axis.end, y, "grid")]
    if found is None:
        return parts
    if not axis.holds(found.mean):
        often = f"{share.mean:.0%} lost, " if share and share.mean > OFTEN else ""
        said = f"{often}{found.mean:.3g} mm →".replace("%", " %")
        return [*parts, text(axis.end, y + 5.0, said, "end", class_="faint", font_size="16")]
    low, high = found.ends
    return [*parts, bar(axis.at(low), y, axis.at(high), y, look), mark(axis.at(found.mean), y, look, told)]


def _key(y: float, told: str, learned: bool) -> list[str]:
    """Say what the kinds of marks mean that there are."""
    ink = Style(COLOURS[-1], "circle", ())
    keys = [(ink, False, "other marks: classical" if learned else "classical")]
    keys += [(ink._replace(mark="diamond"), False, "diamonds, kites: learned")] if learned else []
    keys += [(ink, True, told)] if told else []
    parts = []
    for number, (look, hollow, words) in enumerate(keys):  # what is hollow has a line of its own
        x, row = (22.0, y + 28.0) if hollow else (22.0 + 236.0 * number, y)
        parts += [mark(x, row, look, hollow), text(x + 16.0, row + 5.5, words)]
    return parts


# Error against pull activity.

SIDE, PANEL, ACROSS = 301.0, 220.0, 3
"""Width and height of a scenario's panel [px], and names of the key beside each other."""


def pareto(benchmark: Benchmark) -> str:
    """Draw mean RMSE against mean pull step RMS of each random scenario; the :func:`.chosen` have marks and bars."""
    cases = deciding(benchmark)
    named = in_one_look(benchmark)
    looks = looks_of(benchmark)
    rows = -(-len(cases) // 2)
    parts = [text(12.0, 24.0, "Error against pull activity: lower left is better", font_weight="bold")]
    both = [[benchmark.mean(case, each.name, column.metric) for case in cases for each in benchmark.contenders]
            for column in (PULL_STEP, RMSE)]  # fmt: skip
    for number, case in enumerate(cases):
        left, top = 12.0 + (number % 2) * (SIDE + 14.0), 34.0 + number // 2 * (PANEL + 60.0)
        across = Axis.around(both[0], left + 62.0, left + SIDE - 8.0)
        up = Axis.around(both[1], top + PANEL, top + 28.0)
        parts += [text(across.start, top + 18.0, f"{case.name}: RMSE [mm]", font_size="16")]
        parts += [*_scale(across, up.end, up.start)]
        parts += [line(across.start, up.start, across.start, up.end, "axis")]
        for value in up.ticks:
            parts += [line(across.start, up.at(value), across.end, up.at(value), "grid")]
            parts += [text(across.start - 8.0, up.at(value) + 5.0, f"{value:g}", "end", class_="faint", font_size="16")]
        parts += [text(across.end, up.start + 40.0, PULL_STEP.heading, "end", class_="faint", font_size="16")]
        for each in benchmark.contenders:
            parts += _point(benchmark, case, each, looks[each.name] if each in named else None, across, up)
    top = 34.0 + rows * (PANEL + 60.0) + 16.0
    for number, each in enumerate(named):
        x, y = 24.0 + number % ACROSS * 205.0, top + number // ACROSS * 28.0
        parts += [mark(x, y, looks[each.name], is_told(each, cases[0]))]
        parts += [text(x + 14.0, y + 5.5, short(each.name), font_size="16")]
    height = top + -(-len(named) // ACROSS) * 28.0
    for said in (
        "hollow: told its scenario, tuned for it; grey: others",
        "bars: 95 % intervals; an arrow: further off",
    ):
        parts += [text(12.0, height, said, class_="faint", font_size="16")]
        height += 24.0
    return svg(height - 8.0, parts, "Error against pull activity")


def _point(benchmark: Benchmark, case: Case, each: Contender, look: Style | None, across: Axis, up: Axis) -> list[str]:
    """A controller in a panel: its mark with intervals, a grey dot if it has no look, an arrow where an axis ends."""
    error, moves = (benchmark.get(case, each.name, column.metric) for column in (RMSE, PULL_STEP))
    if error is None or moves is None:
        return []
    x, y = across.at(max(moves.mean, across.low)), up.at(error.mean)
    inside = up.holds(error.mean) and across.holds(moves.mean)
    if look is None:
        return [f'<circle class="faint" cx="{x:.1f}" cy="{y:.1f}" r="3" opacity="0.6"/>'] if inside else []
    parts = []
    if inside:
        (low, high), (slow, fast) = error.ends, moves.ends
        parts = [bar(x, up.at(low), x, up.at(high), look), bar(across.at(slow), y, across.at(fast), y, look)]
    elif error.mean > up.high:
        parts = [text(x + 11.0, y + 5.0, f"↑ {error.mean:.3g}", font_size="13")]
    else:
        words = f"{moves.mean:.3g} →" if moves.mean > across.high else "← 0"
        at_end = moves.mean > across.high
        parts = [text(x + (0.0 if at_end else 12.0), y - 14.0 if at_end else y + 5.0, words,
                      "end" if at_end else "start", font_size="13")]  # fmt: skip
    return [*parts, mark(x, y, look, is_told(each, case), 7.0)]
