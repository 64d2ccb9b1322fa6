"""The ports of a block: its inputs, settings, outputs and alarm bits, and its readings in SI units."""

import inspect
import math
import re
from collections.abc import Mapping
from enum import IntFlag
from functools import cache
from typing import Any

import numpy as np

from cz_gym.body.plant import Puller, make_puller
from cz_gym.config import Config
from cz_gym.observation import CLIP, MEASURED, Measured, scales
from cz_gym.support.units import KILO, MINUTE, MM, MM_PER_MIN

from .program import Port
from .trace import Floats

NO_LIMIT = 1e30
"""A slew rate that limits nothing."""


class Alarm(IntFlag):
    """The bits of ``alarms``."""

    RING = 1
    """The ring reading is invalid, too old, or outside its range; the last good one is held."""
    PYROMETER = 2
    """The pyrometer is outside its range, has jumped, or has not changed for 2 min; the last good reading is held."""
    DRIVES = 4
    """An applied drive is no number or outside its range; the last setpoint is held."""
    REFERENCE = 8
    """The same of a reference or its preview; the last good one is held."""
    LATE = 16
    """The call came more than a tenth of the control interval late."""
    CLOCK = 32
    """The time stood still, ran back, or was no number."""
    PULL_LIMITED = 64
    """The pull speed's range or slew rate cut its setpoint."""
    HEATER_LIMITED = 128
    """The heater's range or slew rate cut its setpoint."""
    TAKEOVER = 256
    """The setpoints still move from the drives found at a takeover to the controller's."""
    FALLBACK = 512
    """The PID controls instead of the controller, until reset or the next takeover."""
    FAILED = 1024
    """The controller's output was no number."""
    MANUAL = 2048
    """The controller does not act: ``automatic`` is not set, a setting is wrong, or a drive was never read. The
    setpoints follow the applied drives."""
    SETTINGS = 4096
    """A setting is no number, or a range or a slew rate is in the wrong order."""
    ASTRAY = 8192
    """A drive has not followed its setpoint for a minute; its setpoint stays near it."""
    MODEL = 16384
    """The controller's model does not explain the readings: the PID takes over."""


def meanings(kind: Any) -> dict[Any, str]:
    """The members of an enumeration with the docstrings below them."""
    members = re.findall(r'^    (\w+) = \d+\n    """(.*?)"""', inspect.getsource(kind), re.MULTILINE | re.DOTALL)
    return {kind[name]: " ".join(text.split()) for name, text in members}


INPUTS = (
    Port("time_s", "time of this call"),
    Port("ring_time_s", "time of the ring reading"),
    Port("ring_radius_mm", "radius of the bright ring, as the camera gives it"),
    Port("valid", "whether the camera says that the reading is good", 1.0, True),
    Port("r_ref_mm", "radius reference now"),
    Port("r_ref_1min_mm", "radius reference in 1 minute"),
    Port("r_ref_5min_mm", "radius reference in 5 minutes"),
    Port("T_1_ref_K", "recipe of the heater temperature now"),
    Port("T_1_ref_1min_K", "recipe in 1 minute"),
    Port("T_1_ref_5min_K", "recipe in 5 minutes"),
    Port("T_1_K", "pyrometer reading of the heater temperature"),
    Port("pull_speed_mm_per_min", "applied pull speed"),
    Port("heater_power_kW", "applied heater power"),
    Port("automatic", "whether the controller acts; a rising edge is a takeover", 1.0, True),
)
"""The inputs of every block."""
READINGS = {
    **{name: (f"{name}_mm", "nominal_radius_mm", "r_0", MM) for name in ("r_ref", "r_ref_1min", "r_ref_5min")},
    **{f"T_1{end}": (f"T_1{end}_K", "nominal_T_1_K", "T_1_0", 1.0) for end in ("_ref", "_ref_1min", "_ref_5min", "")},
    "v_p": ("pull_speed_mm_per_min", "nominal_pull_speed_mm_per_min", "v_0", MM_PER_MIN),
    "Q_H": ("heater_power_kW", "nominal_heater_power_kW", "Q_H_0", KILO),
}
"""Readings but the ring: input, setting with its nominal value, that of a puller, and the input's unit."""
OUTPUTS = (
    Port("pull_speed_setpoint_mm_per_min", "setpoint of the pull speed"),
    Port("heater_power_setpoint_kW", "setpoint of the heater power"),
    Port("alarms", "sum of the alarm bits"),
)
"""The outputs of every block."""
SETPOINTS = dict(zip((port.name for port in OUTPUTS), ("pull_speed_mm_per_min", "heater_power_kW"), strict=False))
"""The setpoints, and the applied drives that follow them."""


def nominal_puller(config: Config) -> Puller:
    """The puller at its operating point that a block is made for."""
    return _puller(config.parameters, config.meniscus)


_puller = cache(lambda parameters, meniscus: make_puller(parameters, 0.5, meniscus))


def settings_of(config: Config, puller: Puller | None = None) -> tuple[Port, ...]:
    """The settings of a block for an environment's puller, or for one that was drawn there; its file's limits of the
    drives are the defaults.
    """
    puller, drives = puller or nominal_puller(config), config.puller
    v_0, Q_0 = puller.v_0 / MM_PER_MIN, puller.Q_H_0 / KILO
    window = min(puller.v_0, math.inf if drives.pull_window is None else drives.pull_window) / MM_PER_MIN
    fastest = min(v_0 + window, math.inf if drives.pull_max is None else drives.pull_max / MM_PER_MIN)
    pull_slew = NO_LIMIT if drives.pull_slew is None else drives.pull_slew / (MM_PER_MIN / MINUTE)
    heater_slew = NO_LIMIT if drives.heater_slew is None else drives.heater_slew / (KILO / MINUTE)
    reach, interval = config.heater_range / KILO, config.control_interval
    latency = max(each.sensor.latency for each in config.scenario.scenarios)
    return (
        Port("nominal_radius_mm", "crystal radius at the operating point", puller.r_0 / MM),
        Port("ring_bias_mm", "the operator's bias: ring radius minus crystal radius at nominal", puller.ring_bias / MM),
        Port("nominal_pull_speed_mm_per_min", "this puller's pull speed at its operating point", v_0),
        Port("nominal_heater_power_kW", "this puller's heater power there", Q_0),
        Port("nominal_T_1_K", "this puller's pyrometer reading there", puller.T_1_0),
        Port("pull_speed_min_mm_per_min", "lowest setpoint of the pull speed", v_0 - window),
        Port("pull_speed_max_mm_per_min", "highest setpoint of the pull speed", fastest),
        Port("heater_power_min_kW", "lowest setpoint of the heater power", max(Q_0 - reach, 0.0)),
        Port("heater_power_max_kW", "highest setpoint of the heater power", Q_0 + reach),
        Port("pull_slew_mm_per_min2", "largest change of the pull speed in a minute; 1e30: no limit", pull_slew),
        Port("heater_slew_kW_per_min", "largest change of the heater power in a minute; 1e30: no limit", heater_slew),
        Port("takeover_s", "time from a takeover to the controller's full authority", 60.0),
        Port("fallback_after_s", "time without good readings after which the PID takes over", 240.0),
        Port("oldest_reading_s", "age from which a ring reading counts as stale", latency + 3.0 * interval),
        Port("gap_s", "time without a call after which the next one is a takeover", max(10.0 * interval, 30.0)),
    )


def readings_of(given: Any, ranges: tuple[float, float]) -> tuple[Measured, Measured]:
    """Readings as deviations in SI units, and whether each lies within the range of the observations; the mean pull
    speed, which is no reading, is the pull speed."""
    seen = {each: (given[port] - given[nominal]) * unit for each, (port, nominal, _, unit) in READINGS.items()}
    ring = (given["ring_radius_mm"] - given["ring_bias_mm"] - given["r_ref_mm"]) * MM
    read = Measured(ring_error=ring, valid=np.where(given["valid"] > 0.5, 1.0, 0.0), v_p_mean=seen["v_p"], **seen)
    limits = 1.001 * CLIP * scales(MEASURED, *ranges)
    return read, Measured(*(np.abs(value) <= limit for value, limit in zip(read, limits, strict=True)))


def in_plant_units(seen: Measured, puller: Any) -> dict[str, Any]:
    """The readings of a sample as a plant has them, by the names of :data:`INPUTS`: the inverse of readings_of."""
    ring = (seen.ring_error + seen.r_ref + puller.r_0 + puller.ring_bias) / MM
    return {"ring_radius_mm": ring, "valid": seen.valid} | {
        port: (getattr(seen, each) + getattr(puller, at_rest)) / unit
        for each, (port, _, at_rest, unit) in READINGS.items()
    }


def in_shares(setpoints: Mapping[str, Any], config: Config) -> Floats:
    """Setpoints by their names in :data:`OUTPUTS` as shares of the drives' ranges above nominal, shape (..., 2)."""
    puller, (pull, heater, _) = nominal_puller(config), OUTPUTS
    power = setpoints[heater.name] * KILO - puller.Q_H_0
    return np.stack([setpoints[pull.name] * MM_PER_MIN / puller.v_0 - 1.0, power / config.heater_range], axis=-1)
