"""A puller as a file: its numbers in TOML, with the unit in every key.

:data:`KEYS` is the one table of keys: reader, writer, errors and the page's table follow from it. A number is read
exactly (decimal text times the unit's size, rounded once), and written with the fewest digits that read back the same.
"""

from __future__ import annotations

import hashlib
import json
import math
import sys
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from decimal import Context, Decimal
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cz_gym.body.plant import make_puller
from cz_gym.body.task import HEATER_RANGE, RADIUS_LIMIT, check_height
from cz_gym.episodes.mixture import Distribution, Mixture
from cz_gym.episodes.scenario import MAX_DEAD_TIME, MAX_LAG, MAX_LATENCY, Range, Scenario
from cz_gym.errors import CzError
from cz_gym.physics.parameters import Parameters, check_parameters
from cz_gym.support.atomic_files import naming, write_files
from cz_gym.support.names import unknown
from cz_gym.support.plausible import IN_MM, IN_MM_PER_MIN, IN_MM_PER_MIN2
from cz_gym.support.units import KILO, MINUTE, MM, MM_PER_MIN, PERCENT

FORMAT = 1
"""Version of the file format."""
FOLDER = Path(__file__).parent / "pullers"
"""Folder of the files that ship."""


UNITS: dict[str, tuple[float, tuple[tuple[str, float, float], ...]]] = {
    "mm": (MM, (("m", 1e3, 0.0), ("µm", 1e-3, 0.0))),
    "mm_per_min": (MM_PER_MIN, (("mm/h", 1.0 / MINUTE, 0.0), ("m/s", 1.0 / MM_PER_MIN, 0.0))),
    "mm_per_min2": (MM_PER_MIN / MINUTE, (("mm/s2", MINUTE * MINUTE, 0.0),)),
    "deg": (math.pi / 180.0, (("rad", 180.0 / math.pi, 0.0),)),
    "K": (1.0, (("°C", 1.0, 273.15),)),
    "s": (1.0, (("ms", 1e-3, 0.0), ("min", MINUTE, 0.0))),
    "rpm": (1.0 / MINUTE, (("rev/s", MINUTE, 0.0),)),
    "percent": (PERCENT, ()),
    "kW": (KILO, (("W", 1e-3, 0.0), ("MW", 1e3, 0.0))),
    "W": (1.0, (("kW", KILO, 0.0),)),
    "kW_per_min": (KILO / MINUTE, (("W/s", MINUTE / KILO, 0.0),)),
    "N_per_m": (1.0, (("mN/m", 1e-3, 0.0),)),
    "kg_per_m3": (1.0, (("g/cm3", KILO, 0.0),)),
    "J_per_kg": (1.0, (("kJ/kg", KILO, 0.0),)),
    "J_per_K": (1.0, (("kJ/K", KILO, 0.0),)),
    "W_per_K": (1.0, (("kW/K", KILO, 0.0),)),
    "W_per_mK": (1.0, (("W/cm/K", 100.0, 0.0),)),
    "W_per_K4": (1.0, ()),
    "W_per_m2K4": (1.0, ()),
    "m_per_s2": (1.0, ()),
    "": (1.0, (("%", PERCENT, 0.0),)),
}
"""Units of keys, by the keys' endings: the size in SI units, and units that users may have meant instead, each with its
name, its factor and its offset to this one."""


class Key(NamedTuple):
    """A number of the file."""

    table: str
    stem: str
    """The key without its unit."""
    unit: str
    """Its ending, of :data:`UNITS`."""
    low: float
    """Smallest plausible value, in the key's unit."""
    high: float
    """Largest plausible value."""
    field: str
    """Its name in :class:`PullerFile`, or in Parameters."""
    drawn: bool = False
    """Whether each crystal draws its own number from a range."""
    later: bool = False
    """Whether it was added after hashes were published; None is then left out of the hash."""

    @property
    def name(self) -> str:
        """The key as it stands in the file."""
        return f"{self.stem}_{self.unit}" if self.unit else self.stem

    @property
    def size(self) -> Fraction:
        """Size of the unit in SI units."""
        return Fraction(UNITS[self.unit][0])


def number(
    table: str,
    unit: str,
    low: float,
    high: float,
    default: Any = None,
    drawn: bool = False,
    stem: str = "",
    later: bool = False,
) -> Any:
    """A number of a puller, with its :class:`Key` in the file, whose stem is the field's name unless one is given."""
    return field(default=default, metadata={"key": Key(table, stem, unit, low, high, "", drawn, later)})


@dataclass(frozen=True)
class PullerFile:
    """A machine: its operating point and hot zone, its drives, its sensors, and how its melt usually fluctuates.

    A number that is None is the scenario's, lengths relative to r_0, speeds to v_0, powers to the heater's range. A
    pair is a range, drawn from anew for each crystal. CzError for numbers that are not plausible, impossible geometry,
    and drives that exclude the operating point.
    """

    name: str = "default"
    parameters: Parameters = field(default_factory=Parameters)
    heater_range: float = number("drives", "kW", 0.05, 500.0, HEATER_RANGE)
    """Largest |Q_H - Q_H0|: what an action of 1 moves the heater by [W]"""
    heater_max: float | None = number("drives", "kW", 0.1, 5e3)
    """Largest power that the heater can have; narrows its range [W]"""
    heater_slew: float | None = number("drives", "kW_per_min", 0.01, 1e3)
    """Largest rate of change of the heater power [W/s]"""
    heater_step: float | None = number("drives", "W", 0.0, 1e4)
    """Resolution of the heater power [W]"""
    heater_lag: Range | None = number("drives", "s", 0.0, MAX_LAG, drawn=True, later=True)
    """Time constant with which the power that heats follows the setpoint [s]"""
    heater_dead_time: Range | None = number("drives", "s", 0.0, MAX_DEAD_TIME, drawn=True, later=True)
    """Time before the power that heats begins to follow the setpoint [s]"""
    pull_max: float | None = number("drives", "mm_per_min", 0.01, 60.0)
    """Largest pull speed; narrows its window [m/s]"""
    pull_window: float | None = number("drives", "mm_per_min", 0.001, 60.0)
    """Largest |v_p - v_0| [m/s]"""
    pull_slew: float | None = number("drives", "mm_per_min2", 0.001, 600.0)
    """Largest rate of change of the pull speed [m/s2]"""
    control_interval: float = number("sensors", "s", 0.1, 60.0, 5.0, stem="interval")
    """Time between actions [s]"""
    camera_noise: Range | None = number("sensors", "mm", 0.0, 2.0, drawn=True)
    """Standard deviation of the white noise on the ring [m]"""
    pyrometer_noise: Range | None = number("sensors", "K", 0.0, 100.0, drawn=True)
    """Standard deviation of the white noise on T_1 [K]"""
    pyrometer_drift: Range | None = number("sensors", "K", -100.0, 100.0, drawn=True)
    """Drift of the pyrometer over 3 h [K]"""
    bias_offset: Range | None = number("sensors", "mm", -5.0, 5.0, drawn=True)
    """Constant offset of the ring from a wrong bias [m]"""
    level_offset: Range | None = number("sensors", "mm", -5.0, 5.0, drawn=True)
    """Constant offset of the ring from the melt level [m]"""
    ripple: Range | None = number("sensors", "mm", 0.0, 5.0, drawn=True)
    """Amplitude of the rotation-synchronous ripple [m]"""
    rotation: Range | None = number("sensors", "rpm", 0.0, 100.0, drawn=True)
    """Crystal rotation [rev/s]"""
    latency: float | None = number("sensors", "s", 0.0, MAX_LATENCY)
    """Age of the newest camera frame [s]"""
    outlier_probability: float | None = number("sensors", "percent", 0.0, 100.0)
    """Share of samples that carry an outlier [-]"""
    outlier_sd: float | None = number("sensors", "mm", 0.0, 5.0)
    """Standard deviation of an outlier [m]"""
    pyrometer_filter: Range | None = number("sensors", "s", 0.0, MAX_LAG, drawn=True, later=True)
    """Time constant of the pyrometer's filter [s]"""
    fluctuation_sd: Range | None = number("melt", "K", 0.0, 100.0, drawn=True)
    """Standard deviation of the fast and of the slow fluctuation of the melt, each drawn on its own [K]"""
    tau_fast: float | None = number("melt", "s", 0.1, 1e5)
    """Correlation time of the fast one [s]"""
    tau_slow: float | None = number("melt", "s", 0.1, 1e6)
    """Correlation time of the slow one [s]"""
    missing: tuple[str, ...] = field(default=(), compare=False, repr=False)
    """Keys that its file does not have: they keep the default's value."""
    file: Path | None = field(default=None, compare=False, repr=False)
    """The file that it was read from; what is designed for it stands beside."""

    def __post_init__(self) -> None:
        if not (isinstance(self.name, str) and self.name.strip() and len(self.name) <= 80 and self.name.isprintable()):
            raise CzError(f"a puller's name must be up to 80 printable characters, not {self.name!r:.100}")
        for key in KEYS:
            _check(key, value_of(self, key))
        object.__setattr__(self, "parameters", check_parameters(self.parameters))
        plant = make_puller(self.parameters)
        check_height(plant)
        highest, fastest = self.heater_max, self.pull_max
        if highest is not None and highest <= plant.Q_H_0:
            raise CzError(
                f"heater_max_kW = {highest / KILO:g} excludes the operating point, "
                f"which needs {plant.Q_H_0 / KILO:.4g} kW"
            )
        if fastest is not None and fastest <= plant.v_0:
            raise CzError(
                f"pull_max_mm_per_min = {fastest / MM_PER_MIN:g} excludes the operating point, "
                f"whose pull speed is {plant.v_0 / MM_PER_MIN:.4g} mm/min"
            )

    @cached_property
    def hash(self) -> str:
        """SHA-256 of everything but the name (16 hex digits)."""
        plain = {key: None if (value := value_of(self, key)) is None else (np.asarray(value, float) + 0.0).tolist()
                 for key in KEYS}  # fmt: skip
        contents: list[Any] = [FORMAT, [value for key, value in plain.items() if not key.later]]
        if later := {key.name: value for key, value in plain.items() if key.later and value is not None}:
            contents.append(later)
        return hashlib.sha256(json.dumps(contents).encode()).hexdigest()[:16]

    @property
    def label(self) -> str:
        """Name and hash, for contracts, reports and errors; "default" for the default puller, whatever its name."""
        return "default" if self.hash == DEFAULT.hash else f"{self.name} ({self.hash})"

    @cached_property
    def power_range(self) -> float:
        """What an action of 1 moves the heater by: its range, or what is left to its largest power [W]."""
        room = math.inf if self.heater_max is None else self.heater_max - make_puller(self.parameters).Q_H_0
        return min(self.heater_range, room)

    @property
    def pull_room(self) -> float:
        """Largest |v_p - v_0| that the file allows; infinite if it allows any [m/s]."""
        room = math.inf if self.pull_max is None else self.pull_max - self.parameters.v_0
        return min(room, math.inf if self.pull_window is None else self.pull_window)

    @property
    def scale(self) -> float:
        """Its radius r_0 in units of the default puller's [-]."""
        return self.parameters.r_0 / DEFAULT.parameters.r_0

    @property
    def radius_limit(self) -> float:
        """Largest |r_c - r_ref| before the crystal is lost [m]."""
        return RADIUS_LIMIT * self.scale


_PARAMETERS = (
    Key("crystal", "radius", "mm", 2.0, 500.0, "r_0"),
    Key("crystal", "pull_speed", "mm_per_min", 0.005, 30.0, "v_0"),
    Key("crystal", "sigma", "N_per_m", 0.01, 5.0, "sigma"),
    Key("crystal", "rho_l", "kg_per_m3", 100.0, 3e4, "rho_l"),
    Key("crystal", "rho_s", "kg_per_m3", 100.0, 3e4, "rho_s"),
    Key("crystal", "alpha_0", "deg", 0.0, 60.0, "alpha_0"),
    Key("crystal", "k_l", "W_per_mK", 0.1, 1e3, "k_l"),
    Key("crystal", "dH", "J_per_kg", 1e4, 1e8, "dH"),
    Key("crystal", "T_m", "K", 200.0, 5e3, "T_m"),
    Key("hot_zone", "dT_0", "K", 0.01, 500.0, "dT_0"),
    Key("hot_zone", "C_1", "J_per_K", 500.0, 1e8, "C_1"),
    Key("hot_zone", "C_2", "J_per_K", 500.0, 1e8, "C_2"),
    Key("hot_zone", "C_b", "J_per_K", 500.0, 1e8, "C_b"),
    Key("hot_zone", "kappa_12", "W_per_K4", 1e-12, 1e-5, "kappa_12"),
    Key("hot_zone", "G_1a", "W_per_K", 0.01, 1e5, "G_1a"),
    Key("hot_zone", "T_a", "K", 200.0, 2e3, "T_a"),
    Key("hot_zone", "G_2b", "W_per_K", 0.01, 1e5, "G_2b"),
    Key("hot_zone", "eps", "", 1e-3, 1.0, "eps"),
    Key("hot_zone", "R_cr", "mm", 5.0, 2e3, "R_cr"),
    Key("hot_zone", "T_e", "K", 0.0, 5e3, "T_e"),
    Key("hot_zone", "g", "m_per_s2", 1e-3, 100.0, "g"),
    Key("hot_zone", "sigma_SB", "W_per_m2K4", 1e-9, 1e-6, "sigma_SB"),
    Key("sensors", "phi_b", "deg", 0.01, 60.0, "phi_b"),
)
_OWN = [
    (key := each.metadata["key"])._replace(stem=key.stem or each.name, field=each.name)
    for each in fields(PullerFile) if each.metadata
]  # fmt: skip
_SENSORS = [key.table for key in _OWN].index("sensors") + 1
KEYS = (*_PARAMETERS[:-1], *_OWN[:_SENSORS], _PARAMETERS[-1], *_OWN[_SENSORS:])
"""Every key of the file, in order."""
TABLES = tuple(dict.fromkeys(key.table for key in KEYS))
"""Tables of the file."""


def value_of(puller: PullerFile, key: Key) -> Any:
    """The number, or range, of a key [SI units]; None: the scenario's own."""
    return getattr(puller.parameters if key in _PARAMETERS else puller, key.field)


def read_puller(path: str | Path) -> PullerFile:
    """Read a puller file; CzError, one line that names the file, for anything that cannot be meant."""
    path = Path(path)
    with naming(path):
        text = path.read_text("utf-8")
    try:
        return replace(_puller(tomllib.loads(text, parse_float=Decimal), path.stem), file=path)
    except (tomllib.TOMLDecodeError, CzError) as error:
        raise CzError(f"{path}: {' '.join(str(error).split())}") from None


def write_puller(puller: PullerFile, path: str | Path) -> None:
    """Write a puller as a file that :func:`read_puller` reads as the same puller, bit for bit."""
    write_files({Path(path): to_toml(puller).encode()})


def find_puller(given: str | Path | PullerFile | None) -> PullerFile:
    """The puller that is meant by a file, a shipped name, or itself; None is the default one."""
    if given is None or isinstance(given, PullerFile):
        return given or DEFAULT
    if not isinstance(given, str | Path):
        raise CzError(
            f"puller must be a puller file, a shipped name or a cz_gym.machine.puller.PullerFile, not {given!r:.80}"
        )
    shipped = {file.stem: file for file in sorted(FOLDER.glob("*.toml"))}
    if str(given) in shipped and not Path(given).exists():
        return read_puller(shipped[str(given)])
    if Path(given).suffix != ".toml" and not Path(given).exists():
        raise CzError(unknown("puller", str(given), shipped, ", or a file NAME.toml"))
    return read_puller(given)


def chosen_puller(given: str | None) -> PullerFile:
    """The puller that a command line names; a line on stderr lists the keys that its file does not have."""
    puller = find_puller(given)
    if puller.missing:
        print(f"puller {puller.label}: the default's values for {', '.join(puller.missing)}", file=sys.stderr)
    return puller


def to_toml(puller: PullerFile) -> str:
    """The puller as the text of a file; numbers that are the scenario's own are left out."""
    lines = [f"format = {FORMAT}", f"name = {json.dumps(puller.name, ensure_ascii=False)}"]
    for table in TABLES:
        lines += ["", f"[{table}]"]
        for key in (each for each in KEYS if each.table == table):
            value = value_of(puller, key)
            if value is not None:
                texts = [_shortest(number, key) for number in (value if isinstance(value, tuple) else (value,))]
                single = texts[0] if len(set(texts)) == 1 else f"[{', '.join(texts)}]"
                lines.append(f"{key.name} = {single}")
    return "\n".join(lines) + "\n"


def _puller(found: Mapping[str, Any], stem: str) -> PullerFile:
    """The puller of a file's content; without a name it has the file's."""
    if found.get("format") != FORMAT:
        raise CzError(f"expected 'format = {FORMAT}' at the top, not {found.get('format', 'nothing')!r:.40}")
    if odd := set(found) - {"format", "name", *TABLES}:
        raise CzError(unknown("table", f"[{min(odd)}]", [f"[{table}]" for table in TABLES]))
    numbers: dict[str, Any] = {}
    missing: list[str] = []
    for table in TABLES:
        given, known = found.get(table, {}), {key.name: key for key in KEYS if key.table == table}
        if not isinstance(given, Mapping):
            raise CzError(f"{table} must be a table [{table}], not {given!r:.40}")
        for name, value in given.items():
            if name not in known:
                raise CzError(_misplaced(table, name, known))
            key, read = known[name], _read(value, known[name])
            numbers[key.field] = (read, read) if key.drawn and not isinstance(read, tuple) else read
        missing += [name for name in known if name not in given]
    parameters = Parameters(**{name: numbers.pop(name) for name in Parameters._fields if name in numbers})
    return PullerFile(found.get("name", stem), parameters, **numbers, missing=tuple(missing))


def _misplaced(table: str, name: str, known: Mapping[str, Key]) -> str:
    """The line on a key that a table does not have."""
    for key in KEYS:
        if key.name == name:
            return f"{name} belongs in [{key.table}], not in [{table}]"
        if key.table == table and name.startswith(f"{key.stem}_"):
            return f"[{table}] has no key {name!r}: did you mean {key.name!r}?"
    return unknown(f"key of [{table}]", name, known)


def _read(value: Any, key: Key) -> Any:
    """A decimal number of the key's unit, or each of a list, in SI units, rounded once; anything else as it is."""
    if isinstance(value, list):
        return tuple(_read(each, key) for each in value)
    if isinstance(value, bool) or not isinstance(value, int | Decimal) or not Decimal(value).is_finite():
        return value
    if not -400 < Decimal(value).adjusted() < 300:  # beyond, a float is infinite, or the fraction needs minutes
        raise CzError(f"{key.name} = {value} is no plausible number")
    return float(Fraction(value) * key.size)


def _shortest(value: float, key: Key) -> str:
    """The shortest decimal number that :func:`_read` reads as this value."""
    exact = Fraction(value) / key.size
    for digits in range(1, 40):
        context = Context(prec=digits)
        text = context.divide(Decimal(exact.numerator), Decimal(exact.denominator))
        if _read(text, key) == value:
            break
    plain = text.normalize(Context(prec=40))
    return f"{plain:f}" if -5 < plain.adjusted() < 7 else f"{plain:E}"


def _check(key: Key, value: Any) -> None:
    """Raise CzError, with a guess at the unit that was meant, unless a key's value is plausible."""
    if value is None and key in _OWN and getattr(PullerFile, key.field) is None:
        return
    size, slips = UNITS[key.unit]
    numbers = value if key.drawn and isinstance(value, tuple) else (value,)
    sound = all(isinstance(each, int | float) and not isinstance(each, bool) for each in numbers)
    if not sound or len(numbers) != 1 + key.drawn or not numbers[0] <= numbers[-1]:
        pair = ", or a pair [low, high] with low <= high" if key.drawn else ""
        given = value if isinstance(value, tuple) else (value,)
        texts = ", ".join(f"{each / size:g}" if isinstance(each, float) else str(each) for each in given)
        raise CzError(f"{key.name} must be a number{pair}, not {f'[{texts}]' if given is value else texts:.60}")
    for number in numbers:
        shown = number / size
        if not key.low - 1e-12 * abs(key.low) <= shown <= key.high + 1e-12 * abs(key.high):
            guesses = [(shown * factor + offset, unit) for unit, factor, offset in slips if shown > 0.0]
            meant = [f": did you mean {guess:.6g} ({shown:g} {unit})?" for guess, unit in guesses
                     if key.low <= guess <= key.high]  # fmt: skip
            raise CzError(f"{key.name} = {shown:g} must lie within {key.low:g} to {key.high:g}{''.join(meant[:1])}")


DEFAULT = PullerFile()
"""The puller that was invented for this project: that of every environment without another one."""


@dataclass(frozen=True)
class ScenarioOn(Scenario):
    """A scenario on a puller: :func:`on` makes one."""

    puller: str = ""
    """Hash of the puller."""

    @property
    def hash(self) -> str:
        """SHA-256 of the scenario's contents and its puller (16 hex digits)."""
        return hashlib.sha256(f"{super().hash} {self.puller}".encode()).hexdigest()[:16]


def on(puller: PullerFile, distribution: Distribution) -> Distribution:
    """The scenario, or each one of a mixture, on a puller.

    What the puller's file says of drives, sensors and melt stands in place of the scenario's. Of the rest, shares,
    temperatures and times stay as they are; lengths are in proportion to r_0, speeds to v_0, powers to the heater's
    range; changes of the reference to v_0 as well, so that the cone angle that they ask for stays. On the default
    puller nothing changes. CzError for a scenario on another puller.
    """
    if isinstance(distribution, Mixture):
        members: Any = tuple(on(puller, each) for each in distribution.scenarios)
        return replace(distribution, scenarios=members)
    there = getattr(distribution, "puller", DEFAULT.hash)
    if there == puller.hash:
        return distribution
    if isinstance(distribution, ScenarioOn):
        raise CzError(f"scenario {distribution.name!r} is on another puller ({there}) than {puller.label}")
    speed = puller.parameters.v_0 / DEFAULT.parameters.v_0
    sizes = {IN_MM: puller.scale, IN_MM_PER_MIN: speed, IN_MM_PER_MIN2: speed}
    power, room = puller.power_range / DEFAULT.power_range, puller.pull_room
    said = {key.field: value_of(puller, key) for key in _OWN} | {"pull_window": room if math.isfinite(room) else None}
    said["sd"] = said["fluctuation_sd"]
    families: dict[str, Any] = {}
    for family in fields(Scenario)[1:]:
        old, values = getattr(distribution, family.name), {}
        for each in fields(old):
            size = (
                power if each.name in ("heater_slew", "heater_step") else sizes.get(each.metadata["member"].slip, 1.0)
            )
            size = speed if family.name == "reference" and each.name == "amount" else size
            stated, own = said.get(each.name), getattr(old, each.name)
            scaled = own if size == 1.0 else tuple(size * end for end in own) if isinstance(own, tuple) else size * own
            values[each.name] = scaled if stated is None else stated
        families[family.name] = type(old)(**values)
    return ScenarioOn(distribution.name, puller=puller.hash, **families)
