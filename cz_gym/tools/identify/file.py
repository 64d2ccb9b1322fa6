"""Puller file of an identification: the start file's text with what the log tells, each number marked by its origin."""

import json
import re

from cz_gym.physics.parameters import MACHINE
from cz_gym.puller.file import FOLDER, PullerFile, defaults_of, from_toml, to_toml, value_of
from cz_gym.support.errors import CzError
from cz_gym.support.units import PERCENT

from .estimate import LAGS, MATERIAL_SD, PRIOR_SD, Estimate, Identified

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
    text = _joined(tables, source, name if shipped else start.name)
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


def _joined(tables: dict[str, list[str]], source: str, name: str) -> str:
    top = [line for line in tables[""] if not line.startswith("name")]
    at = next((k for k, line in enumerate(top) if line.startswith("format")), -1) + 1
    top.insert(at, f"name = {json.dumps(name, ensure_ascii=False)}")
    parts = [f"# {MARK}from {source}; numbers without a mark are as the start file has them.", *top]
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
