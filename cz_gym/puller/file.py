"""A puller as a file: TOML with the unit in every key, from and to numbers in SI units.

Keys are those of :data:`cz_gym.physics.parameters.MACHINE`, from which reader, writer, errors and the page's table
follow. A number is read exactly (decimal text times the unit's size, rounded once), and written with the fewest digits
that read back the same.
"""

import hashlib
import json
import math
import sys
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from decimal import Context, Decimal
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from cz_gym.physics.parameters import (
    MACHINE,
    CameraPose,
    CrystalRecipe,
    Parameters,
    Quantity,
    Range,
    check_parameters,
    pose_for,
)
from cz_gym.physics.plant import RADIUS_LIMIT, check_height, make_puller
from cz_gym.process import HEATER_SCALE
from cz_gym.support.errors import CzError, unknown_name_message
from cz_gym.support.files import name_file_in_errors, write_files
from cz_gym.support.units import CELSIUS, KILO, MM

FORMAT = 1
"""Version of the file format."""
TABLES = {
    table: {quantity.key: quantity for quantity in MACHINE.values() if quantity.table == table}
    for table in dict.fromkeys(quantity.table for quantity in MACHINE.values())
}
"""The tables of the file, and the keys of each."""
OPTIONAL = ("recipe", "camera")
"""The tables whose absence needs no word: only ``CzCrystal-v0`` and images read them."""


def read_numbers(text: str) -> tuple[Any, dict[str, Any], tuple[str, ...]]:
    """Read the name in a file's text (None: there is none), its numbers by symbol, and the keys that it lacks."""
    try:
        content = tomllib.loads(text, parse_float=Decimal)
    except tomllib.TOMLDecodeError as error:
        raise CzError(str(error)) from None
    if content.get("format") != FORMAT:
        raise CzError(f"expected 'format = {FORMAT}' at the top, not {content.get('format', 'nothing')!r:.40}")
    if odd := set(content) - {"format", "name", *TABLES}:
        raise CzError(unknown_name_message("table", f"[{min(odd)}]", [f"[{table}]" for table in TABLES]))
    numbers: dict[str, Any] = {}
    missing: list[str] = []
    for table, known in TABLES.items():
        given = content.get(table, {})
        numbers |= _numbers_of(table, given, known)
        if table in content or table not in OPTIONAL:
            missing += [key for key in known if key not in given and table != "camera"]
    return content.get("name"), numbers, tuple(missing)


def _numbers_of(table: str, given: Any, known: Mapping[str, Quantity]) -> dict[str, Any]:
    """The numbers of a table, by symbol [SI units]."""
    if not isinstance(given, Mapping):
        raise CzError(f"{table} must be a table [{table}], not {given!r:.40}")
    numbers: dict[str, Any] = {}
    for key, value in given.items():
        if key not in known:
            raise CzError(_misplaced(table, key, known))
        quantity, number = known[key], _read(value, known[key])
        pair = quantity.drawn and not isinstance(number, tuple)
        numbers[quantity.symbol] = (number, number) if pair else number
    return numbers


def write_numbers(name: str, numbers: Mapping[str, Any]) -> str:
    """Text of a file with these numbers, by symbol [SI units]; one that is None is left out."""
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
    return unknown_name_message(f"key of [{table}]", key, known)


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


FOLDER = Path(__file__).parent / "shipped"
"""Folder of the files that ship."""
HOTTEST = 3300.0
"""Temperature that graphite heaters stand in inert gas [K]."""
MELT_HEAT = 2.5e6
"""Heat capacity of a melt's volume [J/m3/K]: that of silicon, germanium and gallium arsenide, within 15 %."""


@dataclass(frozen=True)
class PullerFile:
    """A machine: its operating point and hot zone, its drives, its sensors, and how its melt usually fluctuates.

    The page on puller files has each number's meaning and range; here they are in SI units. A number that is None is
    the scenario's, lengths relative to r_0, speeds to v_0, powers to the heater's range. A pair is a range, drawn from
    anew for each crystal. CzError for numbers that are not plausible, impossible geometry, and drives that exclude the
    operating point.
    """

    name: str = "default"
    parameters: Parameters = field(default_factory=Parameters)
    recipe: CrystalRecipe = CrystalRecipe()  # noqa: RUF009  (immutable)
    """Whole crystal that the machine grows."""
    heater_range: float = HEATER_SCALE
    heater_max: float | None = None
    heater_slew: float | None = None
    heater_step: float | None = None
    heater_lag: Range | None = None
    heater_dead_time: Range | None = None
    pull_max: float | None = None
    pull_window: float | None = None
    pull_slew: float | None = None
    control_interval: float = 5.0
    camera_noise: Range | None = None
    pyrometer_noise: Range | None = None
    pyrometer_drift: Range | None = None
    bias_offset: Range | None = None
    level_offset: Range | None = None
    ripple: Range | None = None
    rotation: Range | None = None
    averaging: float | None = None
    latency: float | None = None
    outlier_probability: float | None = None
    outlier_sd: float | None = None
    pyrometer_filter: Range | None = None
    tilt: float | None = None
    distance: float | None = None
    wall_height: float | None = None
    shield_radius: float | None = None
    fluctuation_sd: Range | None = None
    tau_fast: float | None = None
    tau_slow: float | None = None
    missing: tuple[str, ...] = field(default=(), compare=False, repr=False)
    """Keys that the file lacks: they keep the default puller's values."""
    file: Path | None = field(default=None, compare=False, repr=False)
    """The file that it was read from; what is designed for it stands beside."""

    def __post_init__(self) -> None:
        if not (isinstance(self.name, str) and self.name.strip() and len(self.name) <= 80 and self.name.isprintable()):
            raise CzError(f"a puller's name must be up to 80 printable characters, not {self.name!r:.100}")
        for quantity in MACHINE.values():
            _check(self, quantity)
        object.__setattr__(self, "parameters", check_parameters(self.parameters))
        plant = make_puller(self.parameters)
        check_height(plant)
        for symbol, needed, which in (
            ("heater_max", plant.Q_H_0, "which needs"),
            ("pull_max", plant.v_0, "whose pull speed is"),
        ):
            limit, most = getattr(self, symbol), MACHINE[symbol]
            if limit is not None and limit <= needed:
                point = f"the operating point, {which} {needed / most.size:.4g} {most.shown}"
                raise CzError(f"{most.key} = {limit / most.size:g} excludes {point}")
        if plant.T_1_0 > HOTTEST:
            raise CzError(
                f"the heater would have to be at {plant.T_1_0:.0f} K, and none stands more than {HOTTEST:.0f} K: "
                f"check T_m_K = {self.parameters.T_m:g}, T_e_K, G_2b_W_per_K and kappa_12_W_per_K4"
            )
        if (step := self.heater_step or 0.0) >= (power := self.power_range):
            raise CzError(f"heater_step_W = {step:g} is no less than the heater's range, {power / KILO:g} kW")

    @cached_property
    def hash(self) -> str:
        """SHA-256 of everything but name, recipe and camera; the plant's hash has the latter two (16 hex digits)."""
        plain, later = [], {}
        for quantity in MACHINE.values():
            value = value_of(self, quantity)
            value = value if value is None else (np.asarray(value, float) + 0.0).tolist()
            if quantity.table in OPTIONAL:
                continue
            if not quantity.later:
                plain.append(value)
            elif value not in (None, value_of(DEFAULT, quantity)):
                later[quantity.symbol] = value
        contents = [FORMAT, plain, *([later] if later else [])]
        return hashlib.sha256(json.dumps(contents).encode()).hexdigest()[:16]

    @property
    def label(self) -> str:
        """Name and hash, for contracts, reports and errors; "default" for the default puller, whatever its name."""
        return "default" if self.hash == DEFAULT.hash else f"{self.name} ({self.hash})"

    @cached_property
    def power_range(self) -> float:
        """Change of the heater's power by an action of 1: its range, or the rest up to its largest power [W]."""
        room = math.inf if self.heater_max is None else self.heater_max - make_puller(self.parameters).Q_H_0
        return min(self.heater_range, room)

    def pose(self, parameters: Parameters) -> CameraPose:
        """The camera's pose at a puller with these parameters: the file's, and the usual one for what it leaves out."""
        given = {name: getattr(self, name) for name in CameraPose._fields}
        return pose_for(parameters)._replace(**{name: value for name, value in given.items() if value is not None})

    @property
    def pull_room(self) -> float:
        """Largest |v_p - v_0| that the file allows; infinite if it allows any [m/s]."""
        room = math.inf if self.pull_max is None else self.pull_max - self.parameters.v_0
        return min(room, math.inf if self.pull_window is None else self.pull_window)

    @property
    def scale(self) -> float:
        """Ratio of the puller's radius r_0 to the default puller's [-]."""
        return self.parameters.r_0 / DEFAULT.parameters.r_0

    @property
    def radius_limit(self) -> float:
        """Largest |r_c - r_ref| before the crystal is lost [m]."""
        return RADIUS_LIMIT * self.scale


def value_of(puller: PullerFile, quantity: Quantity) -> Any:
    """The number, or range, of a machine's quantity [SI units]; None: the scenario's own."""
    holders = (holder for holder in (puller.parameters, puller.recipe) if hasattr(holder, quantity.symbol))
    return getattr(next(holders, puller), quantity.symbol)


def read_puller(path: str | Path) -> PullerFile:
    """Read a puller file; CzError, one line that names the file, for anything that cannot be meant."""
    with name_file_in_errors(path := Path(path)):
        text = path.read_text("utf-8-sig")
    return replace(from_toml(text, path), file=path)


def from_toml(text: str, source: str | Path = "puller") -> PullerFile:
    """The puller of a file's text; CzError, one line that begins with the text's source, for what cannot be meant."""
    try:
        name, numbers, missing = read_numbers(text)
        parts = (
            {each: numbers.pop(each) for each in kind._fields if each in numbers}
            for kind in (Parameters, CrystalRecipe)
        )
        parameters, recipe = Parameters(**next(parts)), CrystalRecipe(**next(parts))
        return PullerFile(Path(source).stem if name is None else name, parameters, recipe, **numbers, missing=missing)
    except CzError as error:
        raise CzError(f"{source}: {' '.join(str(error).split())}") from None


def write_puller(puller: PullerFile, path: str | Path) -> None:
    """Write a puller as a file that :func:`read_puller` reads as the same puller, bit for bit."""
    write_files({Path(path): to_toml(puller).encode()})


def find_puller(given: str | Path | PullerFile | None) -> PullerFile:
    """Find the puller of a file, a file's text or a shipped name; a puller is itself, None the default one."""
    if given is None or isinstance(given, PullerFile):
        return given or DEFAULT
    if not isinstance(given, str | Path):
        kinds = "a puller file, a shipped name or a cz_gym.puller.file.PullerFile"
        raise CzError(f"puller must be {kinds}, not {given!r:.80}")
    if isinstance(given, str) and "\n" in given:
        return from_toml(given)
    shipped, file = {each.stem: each for each in sorted(FOLDER.glob("*.toml"))}, Path(given)
    if file.suffix != ".toml" and not file.is_file():
        if str(given) not in shipped:
            raise CzError(unknown_name_message("puller", str(given), shipped, ", or a file NAME.toml"))
        file = shipped[str(given)]
    return read_puller(file)


def chosen_puller(given: str | None) -> PullerFile:
    """The puller that a command line names; lines on stderr tell of keys that its file lacks, and of doubts."""
    puller = find_puller(given)
    if taken := defaults_of(puller):
        print(f"puller {puller.label}: the default's values for {', '.join(taken)}", file=sys.stderr)
    for doubt in doubts(puller):
        print(f"puller {puller.label}: {doubt}", file=sys.stderr)
    return puller


def defaults_of(puller: PullerFile) -> dict[str, Any]:
    """Values of the default puller for keys that the puller's file lacks, by key [SI units]."""
    values = {each.key: value_of(DEFAULT, each) for each in MACHINE.values() if each.key in puller.missing}
    return {key: value for key, value in values.items() if value}  # neither the scenario's own, nor nothing


def doubts(puller: PullerFile) -> list[str]:
    """Lines on numbers of a puller that are possible but improbable, each with what may be meant."""
    q, power, nominal = puller.parameters, puller.power_range, make_puller(puller.parameters).Q_H_0
    lines = []
    for each in MACHINE.values():
        value = value_of(puller, each)
        if isinstance(value, float) and not each.holds(value, usual=True):
            usual = each.limits(value, each.shown, usual=True)
            lines.append(f"{each.key} = {value / each.size:g} is unusual, most are {usual}")
    crucible, depth = f"R_cr_mm = {q.R_cr / MM:g}", q.C_b / MELT_HEAT / (math.pi * q.R_cr**2)
    if not 2.0 <= q.R_cr / q.r_0 <= 4.5:
        lines.append(
            f"{crucible} is {q.R_cr / q.r_0:.2g} times radius_mm = {q.r_0 / MM:g}, most are 2 to 4.5 times: "
            "is one of them a diameter, or in another unit?"
        )
    if not 0.15 <= depth / q.R_cr <= 2.5:
        lines.append(
            f"a melt with C_b_J_per_K = {q.C_b:g} would be {depth / MM:.2g} mm deep in a crucible with {crucible}: "
            "is that its diameter, or C_b another melt's?"
        )
    if q.T_e < 0.65 * q.T_m and 0.7 * q.T_m < q.T_e + CELSIUS < q.T_m:
        lines.append(f"T_e_K = {q.T_e:g} is unusually cold: did you mean {q.T_e + CELSIUS:g} ({q.T_e:g} °C)?")
    if (step := puller.heater_step or 0.0) > 0.05 * power:
        lines.append(f"heater_step_W = {step:g} is a coarse step for a heater's range of {power / KILO:g} kW")
    if power > nominal:
        reach, most = power / KILO, nominal / KILO
        lines.append(f"the heater's range of {reach:g} kW is more than the nominal power, {most:.4g} kW")
    return lines


def to_toml(puller: PullerFile) -> str:
    """The puller as the text of a file; numbers that are the scenario's own are left out."""
    return write_numbers(puller.name, {symbol: value_of(puller, quantity) for symbol, quantity in MACHINE.items()})


def _check(puller: PullerFile, quantity: Quantity) -> None:
    """Raise CzError, with a guess at the unit that was meant, unless a number of the puller is plausible."""
    value, drawn = value_of(puller, quantity), quantity.drawn
    if value is None and getattr(PullerFile, quantity.symbol, 0.0) is None:
        return
    numbers = value if drawn and isinstance(value, tuple) else (value,)
    sound = all(isinstance(each, int | float) and not isinstance(each, bool) for each in numbers)
    if not sound or len(numbers) != 1 + drawn or not numbers[0] <= numbers[-1]:
        pair = ", or a pair [low, high] with low <= high" if drawn else ""
        raise CzError(f"{quantity.key} must be a number{pair}, not {_shown(value, quantity.size):.60}")
    for number in numbers:
        if not quantity.holds(number):
            limits = quantity.limits(number, quantity.shown)
            raise CzError(f"{quantity.key} = {number / quantity.size:g} must lie within {limits}")


def _shown(value: Any, size: float) -> str:
    """Text of a value, or of each of a list, in a unit of this size, as a file has it."""
    listed = isinstance(value, tuple)
    texts = [f"{each / size:g}" if isinstance(each, float) else str(each) for each in (value if listed else (value,))]
    return f"[{', '.join(texts)}]" if listed else texts[0]


DEFAULT = PullerFile(**CameraPose()._asdict())
"""The puller that was invented for this project: that of every environment without another one."""
