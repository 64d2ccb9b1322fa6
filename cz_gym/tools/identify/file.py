"""Puller file of an identification: the start file's text with what the log tells, each number marked by its origin."""

import json
import re

from cz_gym.physics.parameters import MACHINE
from cz_gym.puller.file import FOLDER, defaults_of, from_toml, to_toml, value_of
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
    kept = to_toml(start)
    if start.file is not None and start.file.is_file():
        text = start.file.read_text("utf-8-sig")
        if _same(text, start.hash):
            kept = text
    lines = [line for line in kept.splitlines() if not (line.startswith(f"# {MARK}") or (shipped and line[:1] == "#"))]
    values = dict(_numbers(to_toml(puller)))
    marks, tables = _marks(identified), _tables(lines)
    defaults = {} if start.file is None else defaults_of(start)
    for table in dict.fromkeys(each.table for each in MACHINE.values()):
        body = tables.setdefault(table, [])
        places = {found["key"]: (at, found) for at, line in enumerate(body) if (found := LINE.match(line))}
        for quantity in (each for each in MACHINE.values() if each.table == table):
            mark, value = marks.get(quantity.symbol, ""), values.get(quantity.key)
            changed = value_of(puller, quantity) != value_of(start, quantity)
            at, found = places.get(quantity.key, (0, None))
            if found and (changed or mark):
                comment = re.sub(rf"(;\s*)?{MARK}.*$", "", found["comment"] or "")
                said = "; ".join(each for each in (comment, MARK + mark if mark else "") if each)
                body[at] = f"{quantity.key} = {value if changed else found['value']}" + (f" # {said}" if said else "")
            elif not found and changed:
                body.append(f"{quantity.key} = {value} # {MARK}{mark}")
            elif not found and quantity.key in defaults:
                said = f"default, nobody has said it{f'; {mark}' if mark else ''}"
                body.append(f"# {MARK}{quantity.key} = {value} ({said})")
    text = _joined(tables, source, name if shipped else start.name)
    return text if _same(text, puller.hash) else to_toml(puller)


def _same(text: str, wanted: str) -> bool:
    try:
        return from_toml(text).hash == wanted
    except CzError:
        return False


def _numbers(text: str) -> list[tuple[str, str]]:
    return [(found["key"], found["value"]) for line in text.splitlines() if (found := LINE.match(line))]


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
