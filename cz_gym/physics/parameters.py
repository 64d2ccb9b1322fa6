"""The numbers of a machine: unit, meaning, source and plausible range of each, and the parameters of a puller.

:data:`MACHINE` is the one table. Keys of puller files, :class:`Parameters`, members of scenarios, tables of the docs
and refusals follow from it.
"""

import math
from functools import partial
from numbers import Real
from typing import Any, NamedTuple, get_type_hints

from cz_gym.support.errors import CzError
from cz_gym.support.units import CELSIUS, HOUR, KILO, MINUTE, MM, MM_PER_MIN, PERCENT

Range = tuple[float, float]
"""The ends of a range from which a number is drawn; equal ends are a number."""
SIZES: dict[str, dict[str, float]] = {
    "m": {"mm": MM, "cm": 1e-2, "µm": 1e-6}, "m/s": {"mm/min": MM_PER_MIN, "mm/h": MM / HOUR, "mm/s": MM},
    "m/s2": {"mm/min2": MM_PER_MIN / MINUTE, "mm/s2": MM}, "rad": {"deg": math.pi / 180.0}, "1": {"%": PERCENT},
    "K": {"°C": 1.0}, "K/s": {"K/min": 1.0 / MINUTE, "K/h": 1.0 / HOUR}, "s": {"ms": 1e-3, "min": MINUTE},
    "rev/s": {"rpm": 1.0 / MINUTE}, "W": {"kW": KILO, "MW": 1e6}, "W/s": {"kW/min": KILO / MINUTE},
    "N/m": {"mN/m": 1e-3}, "kg": {"g": 1e-3}, "kg/m3": {"g/cm3": KILO}, "J/kg": {"kJ/kg": KILO}, "J/K": {"kJ/K": KILO},
    "W/K": {"kW/K": KILO}, "W/m/K": {"W/cm/K": 100.0}, "W/K4": {}, "W/m2/K4": {}, "m2K/W": {"cm2K/W": 1e-4}, "rev": {},
}  # fmt: skip
"""SI units, each with the units that users may state or mean instead, and their sizes in it."""
_SI = {name: si for si, sizes in SIZES.items() for name in (si, *sizes)}
_ZEROS = {"°C": CELSIUS}
_ROUNDING = 1e-12
_IN_KEYS = {"1": "", "%": "percent"}
_COLDEST = 200.0
"""Least plausible value of a temperature [K]: a quantity with less may be a difference, which is never in °C."""


class Quantity(NamedTuple):
    """A number that a user may state."""

    shown: str
    """Unit in which files and pages show the quantity, one of :data:`SIZES`."""
    meaning: str
    source: str = ""
    low: float | None = None
    """Smallest plausible value [shown unit]; None: any above zero."""
    high: float = math.inf
    """Largest plausible value [shown unit]."""
    stem: str = ""
    """Key of the quantity in a file without the unit, where that is not the symbol."""
    usual: tuple[float, float] = (-math.inf, math.inf)
    """Range outside of which a value is possible but improbable [shown unit]."""
    drawn: bool = False
    """True if each crystal may draw its own value from a range."""
    later: bool = False
    """True if hashes were published before the quantity was added: they leave it out at its default."""
    table: str = ""
    """Table of a puller file that the quantity stands in; empty if there is none."""
    symbol: str = ""
    """Name of the quantity in code."""

    @property
    def unit(self) -> str:
        """SI unit of the quantity."""
        return _SI[self.shown]

    @property
    def size(self) -> float:
        """Size of the shown unit in SI units."""
        return SIZES[self.unit].get(self.shown, 1.0)

    @property
    def key(self) -> str:
        """Key of the quantity in a puller file: the stem, then the unit."""
        over, *under = self.shown.split("/")
        ending = _IN_KEYS.get(self.shown, f"{over}_per_{''.join(under)}" if under else over)
        return f"{self.stem or self.symbol}_{ending}".removesuffix("_")

    def holds(self, value: float, usual: bool = False) -> bool:
        """True if a value [SI unit] is plausible, or even usual."""
        low, high = (end * self.size for end in (self.usual if usual else (self.low or 0.0, self.high)))
        return low - _ROUNDING * abs(low) <= value <= high + _ROUNDING * abs(high)

    def limits(self, value: float, unit: str, usual: bool = False) -> str:
        """The range in this unit, for a line on a value [SI unit] outside of it, with a guess at the unit meant."""
        sizes = {self.unit: 1.0, **SIZES[self.unit]}
        size, ends = sizes.pop(unit), self.usual if usual else (self.low or 0.0, self.high)
        low, high = (end * self.size / size for end in ends)
        if (self.low or 0.0) < _COLDEST:
            sizes.pop("°C", None)
        guesses = {other: value / size * sizes[other] + _ZEROS.get(other, 0.0) for other in sizes}
        meant = [f": did you mean {guess / size:.6g} ({value / size:g} {other})?" for other, guess in guesses.items()
                 if self.holds(guess) and self.holds(guess, usual)]  # fmt: skip
        return f"{low:g} to {high:g}{''.join(meant[:1])}"

    def check(self, what: str, value: float) -> None:
        """Raise CzError, told in the SI unit, unless a value [SI unit] is plausible."""
        if not self.holds(value):
            unit = "" if self.unit == "1" else f" {self.unit}"
            raise CzError(f"{what} = {value:g}{unit} must lie within {self.limits(value, self.unit)}")


Q = Quantity
_L, _E, _II = "silicon literature", "estimate", "Bukhari, Hovd, Winkler, Part II"
_V, _R = f"{_E}: set points of public simulators", partial(Quantity, later=True)
MAX_LATENCY = 60.0
"""Oldest camera frame that a machine may deliver [s]."""
MAX_LAG = 300.0
"""Largest time constant of the heater and of the pyrometer's filter [s]."""
MAX_DEAD_TIME = 60.0
"""Longest dead time of the heater [s]."""
_TABLES: dict[str, dict[str, Quantity]] = {
    "crystal": {
        "r_0": Q("mm", "nominal crystal radius", _II, 2.0, 500.0, "radius", (4.0, 250.0)),
        "v_0": Q("mm/min", "nominal pull speed", _II, 0.005, 30.0, "pull_speed", (0.05, 5.0)),
        "sigma": Q("N/m", "surface tension of the melt", f"{_L}, 0.72-0.83", 0.01, 5.0),
        "rho_l": Q("kg/m3", "density of the melt", f"{_L}, 2510-2570", 100.0, 3e4),
        "rho_s": Q("kg/m3", "density of the crystal", _L, 100.0, 3e4),
        "alpha_0": Q("deg", "contact (growth) angle", _L, 0.0, 89.0),
        "k_l": Q("W/m/K", "thermal conductivity of the melt", _L, 0.1, 1e3),
        "dH": Q("J/kg", "latent heat of fusion", _L, 1e4, 1e8),
        "T_m": Q("K", "melting temperature", _L, 200.0, 3e3),
    },
    "hot_zone": {
        "dT_0": Q("K", "nominal superheat of the melt at the meniscus", f"fitted: stable pole of {_II}", 0.01, 500.0),
        "R": Q("m2K/W", "thermal resistance of the boundary layer between melt bulk and meniscus",
               "none in Part II; 6e-4 to 8e-4 in a public computation of the flow", 0.0, 0.1, "boundary_layer",
               (0.0, 2e-3), later=True),
        "C_1": Q("J/K", "heat capacity of the heater", f"{_E}: 30 kg graphite", 500.0, 1e8),
        "C_2": Q("J/K", "heat capacity of susceptor and crucible", f"{_E}: susceptor and quartz", 500.0, 1e8),
        "C_b": Q("J/K", "heat capacity of the melt bulk", f"{_E}: 80 kg melt", 500.0, 1e8),
        "kappa_12": Q("W/K4", "radiative link heater to susceptor", _E, 1e-12, 1e-5),
        "G_1a": Q("W/K", "insulation loss of the heater", _E, 0.01, 1e5),
        "T_a": Q("K", "ambient (shell) temperature", _E, 200.0, 2e3),
        "G_2b": Q("W/K", "conductance of the quartz wall", _E, 0.01, 1e5),
        "eps": Q("1", "emissivity of the melt surface", f"{_E}: liquid silicon", 1e-3, 1.0),
        "R_cr": Q("mm", "inner radius of the crucible", _E, 5.0, 2e3),
        "T_e": Q("K", "effective temperature the melt surface sees", f"{_E}: heat shield", 0.0, 5e3),
        "g": Q("m/s2", "gravity", "fixed", 1e-3, 100.0),
        "sigma_SB": Q("W/m2/K4", "Stefan-Boltzmann constant", "CODATA", 1e-9, 1e-6),
    },
    "drives": {
        "heater_range": Q("kW", "largest |Q_H - Q_H0|: what an action of 1 moves the heater by", "", 0.05, 500.0),
        "heater_max": Q("kW", "largest power that the heater can have; narrows its range", "", 0.1, 5e3),
        "heater_slew": Q("kW/min", "largest rate of change of Q_H", "", 0.01, 1e3),
        "heater_step": Q("W", "resolution of Q_H - Q_H0", "", 0.0, 1e4),
        "heater_lag": Q("s", "time constant with which the power that heats follows the heater's setpoint", "",
                        0.0, MAX_LAG, drawn=True, later=True),
        "heater_dead_time": Q("s", "time before the power that heats begins to follow the setpoint", "",
                              0.0, MAX_DEAD_TIME, drawn=True, later=True),
        "pull_max": Q("mm/min", "largest pull speed; narrows its window", "", 0.01, 60.0),
        "pull_window": Q("mm/min", "largest |v_p - v_0|", "", 1e-3, 60.0),
        "pull_slew": Q("mm/min2", "largest rate of change of v_p", "", 1e-3, 600.0),
    },
    "sensors": {
        "control_interval": Q("s", "time between actions", "", 0.1, 60.0, "interval"),
        "phi_b": Q("deg", "effective reflection slope of the bright ring, not a camera pose", f"fitted: G_m of {_II}",
                   0.01, 60.0),
        "camera_noise": Q("mm", "standard deviation of the white noise on the ring", "", 0.0, 2.0, drawn=True),
        "pyrometer_noise": Q("K", "standard deviation of the white noise on T_1", "", 0.0, 100.0, drawn=True),
        "pyrometer_drift": Q("K", "drift of the pyrometer, linear over 3 h, then held", "", -100.0, 100.0, drawn=True),
        "bias_offset": Q("mm", "constant offset of the ring from a wrong bias", "", -5.0, 5.0, drawn=True),
        "level_offset": Q("mm", "constant offset of the ring from the melt level", "", -5.0, 5.0, drawn=True),
        "ripple": Q("mm", "amplitude of the rotation-synchronous ripple", "", 0.0, 5.0, drawn=True),
        "rotation": Q("rpm", "crystal rotation", "", 0.0, 100.0, drawn=True),
        "averaging": Q("rev", "revolutions of the crystal that a ring reading is the mean of; 0: a single frame", "",
                       0.0, 20.0, later=True),
        "latency": Q("s", "age of the newest camera frame; frames are taken at samples and on the 5 s grid", "",
                     0.0, MAX_LATENCY),
        "outlier_probability": Q("%", "share of samples that carry an outlier", "", 0.0, 100.0),
        "outlier_sd": Q("mm", "standard deviation of an outlier", "", 0.0, 5.0),
        "pyrometer_filter": Q("s", "time constant of the pyrometer's filter, a first-order lag", "",
                              0.0, MAX_LAG, drawn=True, later=True),
    },
    "camera": {
        "tilt": Q("deg", "angle of the camera's optical axis from the vertical",
                  f"{_E}: viewports stand 15 to 35 deg off", 0.0, 80.0),
        "distance": Q("mm", "from the lens to the melt, along the optical axis", _E, 50.0, 1e4),
        "wall_height": Q("mm", "wall of the crucible that is bare above the melt, up to the heat shield", _E,
                         1.0, 2e3, "bare_wall"),
        "shield_radius": Q("mm", "radius of the heat shield's opening", f"{_E}: r_0 and 48 % of what is left to R_cr",
                           2.0, 2e3),
    },
    "melt": {
        "fluctuation_sd": Q("K", "standard deviation of the fast and of the slow fluctuation of the melt, "
                            "each drawn on its own", "", 0.0, 100.0, drawn=True),
        "tau_fast": Q("s", "correlation time of the fast fluctuation", "", 0.1, 1e5),
        "tau_slow": Q("s", "correlation time of the slow fluctuation", "", 0.1, 1e6),
    },
    "recipe": {
        "M_0": _R("kg", "charge of the crucible", _E, 0.1, 2e3, "charge"),
        "neck_length": _R("mm", "length of the neck before the crown, as wide as the start", _E, 30.0, 1e3),
        "r_start": _R("mm", "radius of the neck, and of the tail's end", "shape of this project", 1.0, 100.0,
                      "start_radius"),
        "crown_length": _R("mm", "length of the crown", "shape of this project", 5.0, 500.0),
        "body_length": _R("mm", "length of the body", "shape of this project", 0.0, 5e3),
        "tail_length": _R("mm", "length of the tail", "shape of this project", 5.0, 1e3),
        "v_start": _R("mm/min", "growth rate at the crown's start", _V, 0.005, 30.0, "start_rate"),
        "v_crown": _R("mm/min", "growth rate in the crown", _V, 0.005, 30.0, "crown_rate"),
        "v_body": _R("mm/min", "growth rate at the body's start", _V, 0.005, 30.0, "body_rate"),
        "v_body_end": _R("mm/min", "growth rate at the body's end", _V, 0.005, 30.0, "body_end_rate"),
        "v_tail": _R("mm/min", "growth rate in the tail", _V, 0.005, 30.0, "tail_rate"),
        "k_s": _R("W/m/K", "thermal conductivity of the crystal at its melting point", _L, 0.1, 1e3),
        "T_fin": _R("K", "temperature that the crystal's wall radiates to", f"{_E}, 1100-1450", 0.0, 3e3),
        "m": _R("1", "exponent of the crystal's heat flux in r_0/r_c", f"{_E}, 0 to 1/2: a radiating cylinder", 0.0,
                2.0, "flux_exponent"),
        "beta": _R("1", "share of the crystal's heat flux that falls with the melt's depth", f"{_E}, 0 to 0.3", 0.0,
                   0.9, "depth_share"),
        "k_0": _R("1", "segregation coefficient of the dopant", "literature: boron in silicon", 1e-9, 10.0,
                  "segregation"),
    },
}  # fmt: skip
MACHINE: dict[str, Quantity] = {
    symbol: quantity._replace(table=table, symbol=symbol)
    for table, quantities in _TABLES.items()
    for symbol, quantity in quantities.items()
}
"""Every number of a machine, by its symbol, in the order of the file."""


class Parameters(NamedTuple):
    """The parameters of a puller and its material; SI units, kelvin, radians.

    Nominal temperatures, power, meniscus height and heat fluxes are *derived* from these by
    :func:`cz_gym.physics.plant.make_puller`. Another puller or material is another instance:
    ``Parameters(r_0=0.1)`` or ``Parameters()._replace(sigma=0.83)``. ``describe`` has each one's unit, meaning,
    source and range.
    """

    sigma: float = 0.72
    rho_l: float = 2570.0
    alpha_0: float = math.radians(11.0)
    g: float = 9.81
    sigma_SB: float = 5.670374419e-8
    k_l: float = 62.0
    rho_s: float = 2330.0
    dH: float = 1.8e6
    T_m: float = 1685.0
    dT_0: float = 5.02
    phi_b: float = math.radians(3.5)
    r_0: float = 87.5 * MM
    v_0: float = 1.2 * MM_PER_MIN
    C_1: float = 5.7e4
    C_2: float = 1.0e5
    C_b: float = 8.0e4
    kappa_12: float = 2.8e-8
    G_1a: float = 30.0
    T_a: float = 350.0
    G_2b: float = 200.0
    eps: float = 0.2
    R_cr: float = 0.28
    T_e: float = 1300.0
    R: float = 0.0


class CrystalRecipe(NamedTuple):
    """A whole crystal that a puller grows: charge, shape, growth rate, and the crystal's loss of heat.

    SI units; the numbers of the table ``[recipe]`` of a puller file. Only ``CzCrystal-v0`` reads them.
    """

    M_0: float = 80.0
    neck_length: float = 150.0 * MM
    r_start: float = 10.0 * MM
    crown_length: float = 90.0 * MM
    body_length: float = 1000.0 * MM
    tail_length: float = 175.0 * MM
    v_start: float = 2.0 * MM_PER_MIN
    v_crown: float = 0.75 * MM_PER_MIN
    v_body: float = 1.25 * MM_PER_MIN
    v_body_end: float = 1.0 * MM_PER_MIN
    v_tail: float = 1.8 * MM_PER_MIN
    k_s: float = 22.0
    T_fin: float = 1300.0
    m: float = 0.5
    beta: float = 0.15
    k_0: float = 0.8


class CameraPose(NamedTuple):
    """Place of the camera above the melt and what its ring mirrors; the table ``[camera]`` of a puller file."""

    tilt: float = math.radians(20.0)
    distance: float = 1.0
    wall_height: float = 0.12
    shield_radius: float = 0.18


def pose_for(q: Parameters) -> CameraPose:
    """The usual pose at a puller, with the heat shield's opening in proportion."""
    usual, silicon = CameraPose(), Parameters()
    opening = (usual.shield_radius - silicon.r_0) / (silicon.R_cr - silicon.r_0)
    return usual._replace(shield_radius=q.r_0 + opening * (q.R_cr - q.r_0))


class Sight(NamedTuple):
    """Lens, bare wall and pixel of a camera, which decide where it sees a bright ring."""

    lens_x: float
    """Distance of the lens from the axis [m]."""
    lens_z: float
    """Height of the lens above the melt [m]."""
    wall_height: float
    """Height of the bare wall above the melt [m]."""
    pixel: float
    """Side of a pixel in focal lengths [-]."""


PIXEL = 6e-4
"""Side of a pixel of the usual camera, in focal lengths [-]: 30 um behind 50 mm."""


def sight_of(pose: CameraPose, aim: float, pixel: float = PIXEL) -> Sight:
    """The sight of a camera in this pose that is aimed at this radius [m]."""
    across, up = pose.distance * math.sin(pose.tilt), pose.distance * math.cos(pose.tilt)
    return Sight(aim + across, up, pose.wall_height, pixel)


def describe(kind: type[Any] = Parameters) -> dict[str, Quantity]:
    """Map the name of each field of this kind of tuple to its :class:`Quantity`."""
    if kind in (Parameters, CrystalRecipe):
        return {name: MACHINE[name] for name in kind._fields}
    hints = get_type_hints(kind, include_extras=True)
    return {name: hints[name].__metadata__[0] for name in kind._fields}


def check_numbers(what: str, values: Any) -> None:
    """Raise CzError naming a field of a tuple of quantities that is no number, or no plausible one."""
    for (name, quantity), value in zip(describe(type(values)).items(), values, strict=True):
        number = isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
        if not number or value < 0 or (value == 0 and quantity.low != 0):
            raise CzError(f"{what} {name} = {value!r} must be a positive finite number [{quantity.unit}]")
        quantity.check(f"{what} {name}", float(value))


def check_parameters(parameters: Parameters) -> Parameters:
    """Return the parameters; raise CzError naming the one that is no plausible number."""
    if not isinstance(parameters, Parameters):
        raise CzError(f"parameters must be a cz_gym.Parameters, not {parameters!r}")
    check_numbers("parameter", parameters)
    r_0, R_cr, T_m, T_e = parameters.r_0, parameters.R_cr, parameters.T_m, parameters.T_e
    if R_cr <= r_0:
        raise CzError(f"the crucible (R_cr = {R_cr} m) must be wider than the crystal (r_0 = {r_0} m)")
    if T_e >= T_m:
        raise CzError(f"parameter T_e = {T_e:g} K, what the melt surface sees, must be below T_m = {T_m:g} K")
    silicon = Parameters()
    if parameters.dH == silicon.dH and abs(T_m + CELSIUS - silicon.T_m) < 5.0:
        raise CzError(f"parameter T_m = {T_m:g} K is silicon's in degrees Celsius: did you mean {T_m + CELSIUS:g}?")
    return Parameters(*map(float, parameters))
