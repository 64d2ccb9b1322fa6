"""Controllers for a puller of the user's own: the paper's design, scaled settings, and what was searched for it.

Settings follow from the default puller's in proportion: times to the time scale of the inverse response (one over the
zero of G_m), gains to the plant's, the temperature loop's to the heater's capacity, an LQG's noise to the file's. What
``python -m cz_gym.baselines.tuning --puller my.toml`` has found stands in the puller's folder and goes before them.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import reduce
from typing import Any

import numpy as np

from cz_gym.action import HEATER_SLACK
from cz_gym.baselines.analysis.compensator_design import CUT_OFF, design_compensator
from cz_gym.baselines.lqg import designs
from cz_gym.baselines.lqg.controller import LQG, LQGDesign
from cz_gym.baselines.pid.compensated_pid import SeriesPID
from cz_gym.baselines.pid.filtered_pid import FilteredPID
from cz_gym.baselines.pid.industrial import Industrial
from cz_gym.baselines.pid.settings import settings_of
from cz_gym.baselines.tuned_for import found_for, with_values
from cz_gym.body.linearisation import RadiusModel, radius_model
from cz_gym.body.plant import Puller, make_puller
from cz_gym.config import Config
from cz_gym.episodes.scenarios import RANDOMIZED
from cz_gym.machine.puller import DEFAULT
from cz_gym.support.units import MM

PIDS = ("paper-tuned", "pid-conventional", "industrial")
"""PIDs that are searched for a puller."""
FILTER = designs.family_name(0.02)
"""The LQG whose filter is searched; the others have the same filter, and their own weights."""
ON_PULLER = ("paper", "paper-here", *PIDS, *(name for name in designs.SHIPPED if name != designs.TOLD))
"""Controllers of the default table on a puller."""
JUMP = 1.0 * MM
"""Largest difference of reading and filter that counts on the default puller, where outliers are to be expected [m]."""
LEAST_PULL = 0.1
"""Least weight of the pull speed of an LQG whose drive has a window or a slew rate, which its regulator does not know:
with less it swings between them until the crystal is lost [-]."""
ERROR_SHARE = 0.5
"""Share of such a drive's window that the radius error alone may ask for [-]."""


SCALED = {
    "time": ("pid.T_i", "pid.T_d", "T_f", "T_start", "T_track", "heater.T_i", "heater.T_pull", "heater.T_mean"),
    "rate": ("compensator.fast", "compensator.slow"),
    "gain": ("pid.K_p", "gain"),
    "compensator": ("compensator.gain",),
    "lead": ("ring_lead",),
    "heat": ("heater.K",),
    "trim": ("heater.K_pull", "heater.limit"),
}
"""Numbers of a PID's settings, by what they are in proportion to: :func:`scale_of`."""


def scale_of(config: Config) -> dict[str, float]:
    """The environment's puller relative to the default one, on Model I of both [-].

    Its time scale and the inverse; the gains of a PID and of a compensator; the ring's lead coefficient; the heater's
    capacity; the melt temperature that changes growth by v_0.
    """
    default, own = radius_model(make_puller()), model_of(config)
    time, trims = default.zero / own.zero, [_trim(make_puller(of)) for of in (config.parameters, DEFAULT.parameters)]
    gains = [design_compensator(model, CUT_OFF / slower).gain for model, slower in ((own, time), (default, 1.0))]
    return {
        "time": time,
        "rate": 1.0 / time,
        "gain": default.numerator / own.numerator / time**2,
        "compensator": gains[0] / gains[1],
        "lead": own.lead / default.lead,
        "heat": config.parameters.C_1 / DEFAULT.parameters.C_1,
        "trim": trims[0] / trims[1],
    }


def model_of(config: Config) -> RadiusModel:
    """Model I of an environment's puller."""
    return radius_model(make_puller(config.parameters, 1.0, config.meniscus))


def _trim(p: Puller) -> float:
    """Temperature of the melt that changes the growth rate by v_0 [K]."""
    return p.v_0 * p.rho_dH * p.h_0 / p.k_l


def paper_here(config: Config) -> FilteredPID:
    """The paper's controller by its own procedure on this puller's linear model.

    Compensator: the stable part of G_p (1 - G_m) behind a high-pass, whose cut-off lies as far below the zero as the
    paper's. PID: Table 1 with its times in units of the zero's, and the gain that gives the same crossover in units of
    the zero: on the default puller the printed numbers, up to the differences of both linear models. What the paper
    does not say is that of ``paper-tuned`` (measurement filter, anti-windup, heater): with tight drives the printed
    controller winds up.
    """
    known: Any = settings_of("paper-tuned", RANDOMIZED)
    printed = replace(known, pid=SeriesPID(), ring_lead=0.0, K_ff=0.0)
    compensator = design_compensator(model_of(config), CUT_OFF / scale_of(config)["time"])
    made: FilteredPID = replace(_scaled(printed, config), compensator=compensator)
    return made


def scaled_pid(name: str, config: Config) -> FilteredPID | Industrial:
    """A PID's settings for the default puller, in proportion to this one."""
    scaled: FilteredPID | Industrial = _scaled(settings_of(name, RANDOMIZED), config)
    return scaled


def _scaled(known: Any, config: Config) -> Any:
    values = {}
    for name, factor in scale_of(config).items():
        for path in SCALED[name]:
            value = reduce(lambda part, each: getattr(part, each, None), path.split("."), known)
            if value is not None and (path, type(known)) != ("T_f", Industrial):  # it filters noise alone
                values[path] = factor * value
    if any(each.sensor.outlier_probability for each in config.scenario.scenarios) and hasattr(known, "jump"):
        values["jump"] = config.puller.scale * JUMP
    return with_values(known, values).for_config(config)


def scaled_design(name: str, config: Config) -> LQGDesign:
    """An LQG's design for the default puller, with this one's camera, sensor noise and melt fluctuation.

    Its filter takes the camera to be no better than the file says, and a ripple that it has not found yet for noise:
    an overconfident filter can explain the ring by a wrong meniscus height, and lose the crystal.
    """
    known, scenario = designs.design_of(name, RANDOMIZED), config.scenario.scenarios[0]
    melt, sensor = scenario.interface, scenario.sensor
    fluctuation = _rms(melt.sd) / _rms(RANDOMIZED.interface.sd)
    least, most = known.noise.camera_sd_range
    noise = replace(
        known.noise,
        fast_sd=fluctuation * known.noise.fast_sd,
        slow_sd=fluctuation * known.noise.slow_sd,
        fast_tau=melt.tau_fast,
        slow_tau=melt.tau_slow,
        pyrometer_sd=_rms(sensor.pyrometer_noise) / _rms(RANDOMIZED.sensor.pyrometer_noise) * known.noise.pyrometer_sd,
        camera_sd=max(float(np.hypot(np.mean(sensor.camera_noise), designs.MEAN_RIPPLE * sensor.ripple[1])), least),
        camera_sd_range=(max(sensor.camera_noise[0], least), most),
        heater_walk=known.noise.heater_walk * config.heater_range / DEFAULT.power_range,
        start_radius_sd=max(scenario.pullers.start_radius_sd, known.noise.start_radius_sd),
    )
    drives = scenario.actuators
    limited = math.isfinite(drives.pull_window) or math.isfinite(drives.pull_slew)
    weights = known.weights._replace(pull=max(known.weights.pull, LEAST_PULL)) if limited else known.weights
    error_pull = ERROR_SHARE * min(drives.pull_window, config.parameters.v_0) if limited else None
    slack = HEATER_SLACK * drives.heater_step
    return replace(
        known, noise=noise, weights=weights, ring=designs.ring_of(sensor), heater_slack=slack, error_pull=error_pull
    )


def _rms(sd: tuple[float, float]) -> float:
    """Root mean square of a standard deviation that is uniform in a range."""
    low, high = sd
    return float(np.sqrt((low * low + low * high + high * high) / 3.0)) or 1e-3


def pid(name: str, config: Config) -> FilteredPID | Industrial:
    """The PID of that name for an environment: what was found for its puller, or scaled."""
    if not _own(name, config):
        return settings_of(name, config.sole_scenario).for_config(config)
    settings: FilteredPID | Industrial = with_values(scaled_pid(name, config), found_for(config.puller, name))
    return settings


def lqg(name: str, config: Config) -> LQG:
    """The LQG of that name for an environment: with the filter that was found for its puller, or a scaled one."""
    if not _own(name, config):
        return designs.lqg(name, config)
    found = found_for(config.puller, FILTER)
    filter_alone = {path: value for path, value in found.items() if name == FILTER or path.startswith("noise.")}
    return LQG(design=with_values(scaled_design(name, config), filter_alone)).for_config(config)


def _own(name: str, config: Config) -> bool:
    """Whether a controller has settings of its own on the puller of an environment."""
    return config.puller != DEFAULT and name in ON_PULLER
