"""Identify a puller from its logs: ``cz-gym identify LOG.csv --puller start.toml --out my.toml``.

The puller file is the start file's text with what the log tells, each number marked by its origin. Beside it stands a
report, Markdown with two pictures: the numbers that the log tells, and those it does not.
"""

import argparse
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cz_gym.episodes.scenario import to_csv
from cz_gym.evaluation.plots import COLOURS, GREY, INK, canvas, png
from cz_gym.physics.parameters import MACHINE, describe
from cz_gym.physics.plant import make_puller
from cz_gym.puller.file import FOLDER, PullerFile, defaults_of, find_puller, from_toml, to_toml, value_of
from cz_gym.support.command_line import OneLineParser
from cz_gym.support.errors import CzError
from cz_gym.support.files import check_writable, write_files
from cz_gym.support.units import HOUR, KILO, MM, MM_PER_MIN, PERCENT
from cz_gym.tools.report.tables import markdown

from .estimate import (
    COLOURED,
    LAGS,
    MATERIAL_SD,
    PRIOR_SD,
    SENSORS,
    Estimate,
    Identified,
    coloured,
    identify,
)  # fmt: skip
from .log import COLUMNS, Log, add_log_options, check_puller, read_given
from .model import Lags

NO_FIT = 3
"""Exit code where the model does not fit the log."""
CALLIPER = 0.05 * MM
"""Error of a calliper's reading of the radius [m]."""
OTHERS = {
    "lam": ("lam dT_0", "K"),
    "camera_sd": ("camera noise", "m"),
    "pyrometer_sd": ("pyrometer noise", "K"),
    "fast_sd": ("melt, fast fluctuation", "K"),
    "slow_sd": ("melt, slow fluctuation", "K"),
    "load_rate": ("hot zone, rate of drift", "1/s"),
    "heater_lag": ("heater's lag", "s"),
    "heater_dead_time": ("heater's dead time", "s"),
    "pyrometer_filter": ("pyrometer's filter", "s"),
}
"""Names and units of the numbers that are no parameters."""
HEADS = "number", "unit", "start", "log", "95 % interval", "uncertainty left [%]", "verdict"


def report(identified: Identified, log: Log | Sequence[Log], source: str, path: Path) -> dict[Path, bytes]:
    """Write a report on the log named ``source``; return its files, the text at ``path``."""
    readings, numbers = (path.with_name(f"{path.stem}-{name}.png") for name in ("readings", "numbers"))
    told = sum(e.informed for e in identified.estimates)
    moves = zip(("pull speed", "heater"), identified.excitation, strict=True)
    correlations = [f"{name} {coloured(errors):.2f}" for name, errors in zip(SENSORS, identified.errors.T, strict=True)]
    logs = (log,) if isinstance(log, Log) else log
    notes = ["; ".join(each.notes) or "nothing was left out" for each in logs]
    lines = [f"- {len(each.time)} rows of {each.interval:g} s; {note}." for each, note in zip(logs, notes, strict=True)]
    text = f"""# {identified.verdict[0].upper() + identified.verdict[1:]}

The log {source} tells {told} of {len(identified.estimates)} numbers of the puller {identified.start.name};
the others keep the start's values.

{markdown(HEADS, map(_row, (*identified.estimates, *identified.noise)), "---")}

"Uncertainty left" compares the estimate's standard deviation with the start's; below 50 % the log tells the number.
A log gives lam and dT_0 only as their product, the delays of the heater's path best as their sum, and no phi_b.

![start and estimates]({numbers.name})

## Excitation

{chr(10).join(f"- {name}: {_moved(share)}" for name, share in moves)}

## Predicted and measured

![readings and their prediction errors]({readings.name})

Largest correlation of the prediction errors: {", ".join(correlations)}. Above {COLOURED:g} something moves the readings
that the model does not have.

## What one calliper reading would add

{_calliper(identified)}

## The log

{chr(10).join(lines)}
"""
    return {path: text.encode(), readings: _readings(identified), numbers: _numbers(identified)}


def _name_of(e: Estimate) -> tuple[str, str]:
    """Return an estimate's name for readers and its unit."""
    return OTHERS.get(e.name) or (e.name, describe()[e.name].unit)


def _row(e: Estimate) -> tuple[str, ...]:
    name, unit = _name_of(e)
    if not e.excited:
        return name, unit, f"{e.prior:.4g}", "-", "-", "-", "not estimated: its drive was not excited"
    verdict = "told" if e.informed else "this log says nothing about it" if e.trusted else "not to be trusted"
    if e.name in Lags._fields and not e.trusted:
        verdict = "no delay, or none that this log shows"
    interval = f"{e.low:.4g} to {e.high:.4g}"
    return name, unit, f"{e.prior:.4g}", f"{e.value:.4g}", interval, f"{e.left / PERCENT:.0f}", verdict


def _moved(share: float) -> str:
    if share >= 1.0:
        return f"moves of its own, {share:.3g} times what is needed"
    return (
        f"{share:.2g} of the moves that are needed (the pull speed's count only beside the heater's). The readings "
        "explain the others, as a controller's moves, and such a log misleads: the numbers of this drive were not "
        "estimated. `identify.Excited` makes the moves."
    )


def _calliper(identified: Identified) -> str:
    """Say how well phi_b would be known from the ring's offset and a calliper reading of the crystal."""
    parameters = (identified.start if identified.misfits else identified.puller).parameters
    step = 1e-4
    ring = make_puller(parameters).ring_bias
    slope = (make_puller(parameters._replace(phi_b=parameters.phi_b + step)).ring_bias - ring) / step
    middle, (gain, sd) = identified.ring_outside, identified.ring_gain
    share = f"{gain:.2f} times as much as the file's (standard deviation {sd:.2f})"
    moves = f" With the meniscus' height it moves {share}." if np.isfinite(sd) else ""
    return (
        f"The ring is {middle / MM:.2f} mm outside the reference, in the middle of the log; with phi_b = "
        f"{np.degrees(parameters.phi_b):.2f} deg it is {ring / MM:.2f} mm outside the crystal.{moves} The log "
        "cannot say how much of the difference is an error of the radius. A calliper reading of the crystal, to "
        f"{CALLIPER / MM:g} mm of its radius, gives phi_b to {np.degrees(CALLIPER / abs(slope)):.2g} deg, "
        "and with it the true radius."
    )


def _readings(identified: Identified) -> bytes:
    """Draw drives, readings with their predictions, and prediction errors, as PNG."""
    figure, log, hours = canvas(8.0, 8.0), identified.log, identified.log.time / HOUR
    drives, ring, pyrometer, errors = figure.subplots(4, 1, sharex=True)
    drives.plot(hours, log.v_p / MM_PER_MIN, color=COLOURS[1], lw=0.8, label="pull speed [mm/min]")
    power = drives.twinx()
    power.plot(hours, log.Q_H / KILO, color=COLOURS[0], lw=0.8, label="heater power [kW]")
    for axis, values, error, size, label in (
        (ring, log.ring, identified.predicted.error[:, 1], MM, "ring radius [mm]"),
        (pyrometer, log.T_1, identified.predicted.error[:, 0], 1.0, "T_1 [K]"),
    ):
        axis.plot(hours, values / size, ".", color=GREY, ms=2, label="measured")
        axis.plot(hours, (values - error) / size, color=COLOURS[1], lw=0.8, label="predicted")
        axis.set_ylabel(label)
    for sensor, name in enumerate(SENSORS):
        errors.plot(hours, identified.errors[:, sensor], ".", color=COLOURS[sensor], ms=2, label=name)
    drives.set_ylabel("pull speed [mm/min]", color=COLOURS[1])
    power.set_ylabel("heater power [kW]", color=COLOURS[0])
    errors.set(xlabel="time [h]", ylabel="error / its sd [-]", ylim=(-5.0, 5.0))
    for axis in (ring, errors):
        axis.legend(fontsize=7.5, frameon=False, ncols=2)
    return png(figure)


def _numbers(identified: Identified) -> bytes:
    """Draw start and estimates with their 95 % intervals, relative to the start, as PNG."""
    figure = canvas(7.0, 4.5)
    axis = figure.subplots()
    shown = [e for e in identified.estimates if e.name not in Lags._fields]
    for y, e in enumerate(shown):
        colour = COLOURS[0] if e.informed else GREY
        axis.plot([max(e.low, 0.0) / e.prior, e.high / e.prior], [y, y], color=colour, lw=2)
        axis.plot(e.value / e.prior, y, "o", color=colour)
    axis.axvline(1.0, color=INK, lw=0.8)
    axis.set_yticks(range(len(shown)), [OTHERS.get(e.name, (e.name,))[0] for e in shown])
    axis.invert_yaxis()
    axis.set_xlabel("estimate / start [-]; grey: this log says nothing about it")
    return png(figure)


# The puller file.

SYMBOLS = {"camera_sd": "camera_noise", "pyrometer_sd": "pyrometer_noise"}
"""Estimates with another name than the file's number."""
MARK = "identify: "
"""Beginning of the comments that are written here, and replaced where a file is identified again."""
LINE = re.compile(r"\s*(?P<key>\w+)\s*=\s*(?P<value>\[[^\]#]*\]|\"[^\"]*\"|[^#\[\"]+?)\s*(?:#\s*(?P<comment>.*))?$")


def puller_text(identified: Identified, source: str, name: str) -> str:
    """Text of the identified puller's file.

    Comments and the name are the start file's (a shipped file's are not: ``name``). Beside each number stands where it
    is from: estimated, with its 95 % interval; prior; default, which stays a comment, so that it is no fact.
    """
    start, puller = identified.start, identified.puller
    shipped = start.file is None or start.file.parent == FOLDER
    lines = [line for line in _text_of(start).splitlines() if not line.startswith(f"# {MARK}")]
    tables = _tables([line for line in lines if not (shipped and line[:1] == "#")])
    values = {found["key"]: found["value"] for line in to_toml(puller).splitlines() if (found := LINE.match(line))}
    marks, defaults = _marks(identified), {} if start.file is None else defaults_of(start)
    for quantity in MACHINE.values():
        changed = value_of(puller, quantity) != value_of(start, quantity)
        body, mark = tables.setdefault(quantity.table, []), marks.get(quantity.symbol, "")
        _write_number(body, quantity.key, values.get(quantity.key), mark, changed, quantity.key in defaults)
    known = identified.posterior.lines() if identified.posterior and not identified.misfits else []
    text = _joined(tables, source, name if shipped else start.name, known)
    return text if _same(text, puller.hash) else to_toml(puller)


def _text_of(start: PullerFile) -> str:
    """Text of the start file as its author wrote it, where it is still the same puller."""
    if start.file is not None and start.file.is_file():
        text = start.file.read_text("utf-8-sig")
        if _same(text, start.hash):
            return text
    return to_toml(start)


def _write_number(body: list[str], key: str, value: str | None, mark: str, changed: bool, default: bool) -> None:
    """Write a number with its mark into the lines of its table: in its place, or at the end if the file lacks it."""
    places = {found["key"]: (at, found) for at, line in enumerate(body) if (found := LINE.match(line))}
    at, found = places.get(key, (0, None))
    if not found:
        if changed:
            body.append(f"{key} = {value} # {MARK}{mark}")
        elif default:
            body.append(f"# {MARK}{key} = {value} (default, nobody has said it{f'; {mark}' if mark else ''})")
    elif changed or mark:
        comment = re.sub(rf"(;\s*)?{MARK}.*$", "", found["comment"] or "")
        said = "; ".join(each for each in (comment, MARK + mark if mark else "") if each)
        body[at] = f"{key} = {value if changed else found['value']}" + (f" # {said}" if said else "")


def _same(text: str, wanted: str) -> bool:
    try:
        return from_toml(text).hash == wanted
    except CzError:
        return False


def _tables(lines: list[str]) -> dict[str, list[str]]:
    """Lines by table, those above the first one under an empty name; without blank lines at the ends."""
    tables: dict[str, list[str]] = {"": []}
    for line in lines:
        head = re.match(r"\s*\[(\w+)\]\s*(#.*)?$", line)
        if head:
            tables[head[1]] = [head[2]] if head[2] else []
        else:
            tables[next(reversed(tables))].append(line)
    for body in tables.values():
        while body and not body[-1].strip():
            body.pop()
    return tables


def _joined(tables: dict[str, list[str]], source: str, name: str, known: list[str]) -> str:
    top = [line for line in tables[""] if not line.startswith("name")]
    at = next((k for k, line in enumerate(top) if line.startswith("format")), -1) + 1
    top.insert(at, f"name = {json.dumps(name, ensure_ascii=False)}")
    parts = [f"# {MARK}from {source}; numbers without a mark are as the start file has them.", *known, *top]
    for table, body in tables.items():
        parts += ["", f"[{table}]", *body] if table and body else []
    return "\n".join(parts) + "\n"


def _marks(identified: Identified) -> dict[str, str]:
    """Origins of numbers by symbol, in words."""
    marks = {}
    noise = {e.name: e for e in identified.noise}
    told = identified.puller
    for e in (*identified.estimates, *identified.noise):
        quantity = MACHINE.get(SYMBOLS.get(e.name, e.name))
        if quantity is None:
            continue
        if value_of(told, quantity) != value_of(identified.start, quantity):
            marks[quantity.symbol] = f"estimated, 95 % interval {_ends(e, quantity.size)}"
        elif e.name in LAGS or e.name in SYMBOLS:
            continue
        else:
            sd, source = MATERIAL_SD.get(e.name, (PRIOR_SD, "a hot zone is guessed"))
            sd, source = (identified.sds[e.name], "told") if e.name in identified.told_sds else (sd, source)
            why = "the log does not tell it" if e.excited else "not estimated, its drive was not excited"
            marks[quantity.symbol] = f"prior, standard deviation {sd / PERCENT:g} % ({source}): {why}"
    if told.fluctuation_sd != identified.start.fluctuation_sd:
        ends = (f"{kind} {_ends(noise[f'{kind}_sd'], 1.0)}" for kind in ("fast", "slow"))
        marks["fluctuation_sd"] = f"estimated, 95 % intervals: {', '.join(ends)}"
        marks |= dict.fromkeys(("tau_fast", "tau_slow"), "assumed in the estimate")
    return marks


def _ends(e: Estimate, size: float) -> str:
    return f"{max(e.low, 0.0) / size:.3g} to {e.high / size:.3g}, start {e.prior / size:.3g}"


# The command.


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser("cz-gym identify", "Identify a puller from its logs.")
    add = parser.add_argument
    add("log", type=Path, nargs="+", help=f"CSV or Parquet file of one machine, with the columns {', '.join(COLUMNS)}")
    add("--puller", default="default", help="puller file to start from (default: %(default)s)")
    add("--out", type=Path, required=True, help="puller file to write; its report stands beside it")
    about = "write the load on the melt and the fluctuations of the log too, as a scenario: scenario='FILE.csv'"
    add("--series", type=Path, metavar="FILE.csv", help=about)
    add_log_options(parser)
    add("--prior", action="append", default=[], metavar="NAME=SD", help="sd of the logarithm of a start value")
    add("--force", action="store_true", help="write the puller file although the model does not fit the log")
    return parser.run(_main, arguments, "plant")


def _check_outputs(given: argparse.Namespace, start: PullerFile) -> None:
    """Raise CzError for names of output files that cannot or must not be written."""
    for option, path, suffix in (("--out", given.out, ".toml"), ("--series", given.series, ".csv")):
        if path is not None and path.suffix != suffix:
            raise CzError(f"{option} must be a file NAME{suffix}, not {path}")
        if path is not None:
            check_writable(path.absolute().parent)
    if start.file is not None and given.out.exists() and given.out.samefile(start.file):
        raise CzError(f"--out {given.out} is the file to start from: name another one")


def _main(given: argparse.Namespace) -> int:
    from tqdm import tqdm

    start = find_puller(given.puller)
    _check_outputs(given, start)
    logs = [read_given(path, given) for path in given.log]
    for path, log in zip(given.log, logs, strict=True):
        check_puller(log, start, str(path))
    shown: Any = {"bar_format": "fitting: {n_fmt} steps in {elapsed}", "leave": False, "disable": None}
    with tqdm(**shown) as bar:
        identified = identify(logs, start, dict(map(_prior, given.prior)), progress=bar.update)
    page, files = given.out.with_suffix(".md"), dict[Path, bytes]()
    names = ", ".join(path.name for path in given.log)
    if given.force or not identified.misfits:
        files[given.out] = puller_text(identified, names, given.out.stem).encode()
        files |= {given.series: to_csv(identified.series()).encode()} if given.series else {}
    print(identified.verdict)
    for path, log in zip(given.log, logs, strict=True):
        print(*(f"{path.name}: {note}" for note in log.notes), sep="\n", end="\n" if log.notes else "")
    write_files(report(identified, logs, names, page) | files)
    for e in identified.estimates:
        told = f"{e.value:.4g} ({e.low:.4g} to {e.high:.4g}) {_name_of(e)[1]}"
        print(f"{e.name}: {told if e.informed else 'this log says nothing about it'}")
    print(f"wrote {' and '.join(map(str, (*files, page)))}")
    return NO_FIT if identified.misfits else 0


def _prior(text: str) -> tuple[str, float]:
    name, _, sd = text.partition("=")
    try:
        return name, float(sd)
    except ValueError:
        raise CzError(f"--prior {text}: write it as NAME=SD") from None
