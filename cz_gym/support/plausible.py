"""Plausible ranges of numbers from the user, with a guess at the unit that was meant."""

from __future__ import annotations

import math
from typing import NamedTuple

from cz_gym.errors import CzError
from cz_gym.support.units import KILO, MINUTE, MM, MM_PER_MIN, PERCENT


class Slip(NamedTuple):
    """A unit that is often used by mistake; the SI value is ``number * factor + offset``."""

    unit: str
    factor: float
    offset: float = 0.0


IN_MM = Slip("mm", MM)
IN_MM_PER_MIN = Slip("mm/min", MM_PER_MIN)
IN_MM_PER_MIN2 = Slip("mm/min2", MM_PER_MIN / MINUTE)
IN_K_PER_MIN = Slip("K/min", 1.0 / MINUTE)
IN_REV_PER_MIN = Slip("rev/min", 1.0 / MINUTE)
IN_CELSIUS = Slip("degrees Celsius", 1.0, 273.15)
IN_DEGREES = Slip("degrees", math.pi / 180.0)
IN_PERCENT = Slip("%", PERCENT)
IN_KILO = Slip("thousands", KILO)
IN_MILLI = Slip("thousandths", 1.0 / KILO)


def check_plausible(what: str, value: float, low: float, high: float, unit: str = "", slip: Slip | None = None) -> None:
    """Raise CzError, with a guess at what was meant, unless ``low <= value <= high``."""
    if low <= value <= high:
        return
    guess = math.nan if slip is None else value * slip.factor + slip.offset
    meant = f": did you mean {guess:.6g} ({value:g} {slip.unit})?" if slip and low <= guess <= high else ""
    raise CzError(f"{what} = {value:g}{unit and f' {unit}'} must lie within {low:g} to {high:g}{meant}")
