"""The text of a puller file: TOML, with the unit in every key, from and to numbers in SI units.

A number is read exactly (decimal text times the unit's size, rounded once), and written with the fewest digits that
read back the same.
"""

import json
import tomllib
from collections.abc import Mapping
from decimal import Context, Decimal
from fractions import Fraction
from typing import Any

from cz_gym.errors import CzError
from cz_gym.physics.quantities import MACHINE, Quantity
from cz_gym.support.names import unknown

FORMAT = 1
"""Version of the file format."""
TABLES = {
    table: {quantity.key: quantity for quantity in MACHINE.values() if quantity.table == table}
    for table in dict.fromkeys(quantity.table for quantity in MACHINE.values())
}
"""The tables of the file, and the keys of each."""
OPTIONAL = "recipe"
"""The table whose absence needs no word: only ``CzCrystal-v0`` reads it."""


def read_numbers(text: str) -> tuple[Any, dict[str, Any], tuple[str, ...]]:
    """The name in a file's text (None: it has none), its numbers by symbol, and the keys that it does not have."""
    try:
        content = tomllib.loads(text, parse_float=Decimal)
    except tomllib.TOMLDecodeError as error:
        raise CzError(str(error)) from None
    if content.get("format") != FORMAT:
        raise CzError(f"expected 'format = {FORMAT}' at the top, not {content.get('format', 'nothing')!r:.40}")
    if odd := set(content) - {"format", "name", *TABLES}:
        raise CzError(unknown("table", f"[{min(odd)}]", [f"[{table}]" for table in TABLES]))
    numbers: dict[str, Any] = {}
    missing: list[str] = []
    for table, known in TABLES.items():
        given = content.get(table, {})
        if not isinstance(given, Mapping):
            raise CzError(f"{table} must be a table [{table}], not {given!r:.40}")
        for key, value in given.items():
            if key not in known:
                raise CzError(_misplaced(table, key, known))
            quantity, number = known[key], _read(value, known[key])
            pair = quantity.drawn and not isinstance(number, tuple)
            numbers[quantity.symbol] = (number, number) if pair else number
        if table in content or table != OPTIONAL:
            missing += [key for key in known if key not in given]
    return content.get("name"), numbers, tuple(missing)


def write_numbers(name: str, numbers: Mapping[str, Any]) -> str:
    """The text of a file with these numbers, by symbol [SI units]; one that is None is left out."""
    lines = [f"format = {FORMAT}", f"name = {json.dumps(name, ensure_ascii=False)}"]
    for table, known in TABLES.items():
        lines += ["", f"[{table}]"]
        for key, quantity in known.items():
            value = numbers[quantity.symbol]
            if value is not None:
                texts = [_shortest(number, quantity) for number in (value if isinstance(value, tuple) else (value,))]
                single = texts[0] if len(set(texts)) == 1 else f"[{', '.join(texts)}]"
                lines.append(f"{key} = {single}")
    return "\n".join(lines) + "\n"


def _misplaced(table: str, key: str, known: Mapping[str, Quantity]) -> str:
    """The line on a key that a table does not have."""
    for each in MACHINE.values():
        if each.key == key:
            return f"{key} belongs in [{each.table}], not in [{table}]"
        if each.table == table and key.startswith(f"{each.stem or each.symbol}_"):
            return f"[{table}] has no key {key!r}: did you mean {each.key!r}?"
    return unknown(f"key of [{table}]", key, known)


def _read(value: Any, quantity: Quantity) -> Any:
    """A decimal number in the shown unit, or each of a list, in SI units, rounded once; anything else as it is."""
    if isinstance(value, list):
        return tuple(_read(each, quantity) for each in value)
    if isinstance(value, bool) or not isinstance(value, int | Decimal) or not Decimal(value).is_finite():
        return value
    if not -400 < Decimal(value).adjusted() < 300:  # beyond, a float is infinite, or the fraction needs minutes
        raise CzError(f"{quantity.key} = {value} is no plausible number")
    return float(Fraction(value) * Fraction(quantity.size))


def _shortest(value: float, quantity: Quantity) -> str:
    """The shortest decimal number that :func:`_read` reads as this value."""
    exact = Fraction(value) / Fraction(quantity.size)
    for digits in range(1, 40):
        context = Context(prec=digits)
        text = context.divide(Decimal(exact.numerator), Decimal(exact.denominator))
        if _read(text, quantity) == value:
            break
    plain = text.normalize(Context(prec=40))
    return f"{plain:f}" if -5 < plain.adjusted() < 7 else f"{plain:E}"
