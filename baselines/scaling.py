"""Settings of the default puller's controllers in proportion to another puller: of PIDs, of LQGs, of whole crystals.

Times follow the zero of G_m, gains the plant's, the temperature loop's the heater's capacity; a Kalman filter follows
the camera, the sensors and the melt of the puller's file.
"""

import math
from dataclasses import replace
from functools import reduce
from typing import Any

import numpy as np

from cz_gym.body.process import RadiusModel, radius_model
from cz_gym.config import Config
from cz_gym.episodes.scenarios import RANDOMIZED
from cz_gym.jit import labelled
from cz_gym.physics.parameters import Parameters
from cz_gym.physics.plant import make_puller
from cz_gym.process import HEATER_SCALE, PULL_SCALE
from cz_gym.puller.file import DEFAULT
from cz_gym.spaces import HEATER_SLACK
from cz_gym.support.units import MM

from .analysis import CUT_OFF, design_compensator
from .crystal import CrystalPID
from .lqg import LQGDesign
from .lqg_filter import expect_errors, ring_of, ripple_left
from .tuned import with_values

JUMP = 1.0 * MM
"""Largest difference of reading and filter that counts on the default puller, where outliers are to be expected [m]."""
LEAST_PULL = 0.1
"""Least weight of the pull speed of an LQG whose drive has a window or a slew rate, which its regulator ignores: with
less it swings between them until the crystal is lost [-]."""
ERROR_SHARE = 0.5
"""Share of such a drive's window that the radius error alone may ask for [-]."""
PROPORTIONAL = {
    "time": ("pid.T_i", "pid.T_d", "T_f", "T_start", "T_track", "heater.T_i", "heater.T_pull", "heater.T_mean"),
    "rate": ("compensator.fast", "compensator.slow"),
    "gain": ("pid.K_p",),
    "compensator": ("compensator.gain",),
    "lead": ("ring_lead",),
    "heat": ("heater.K",),
    "trim": ("heater.K_pull", "heater.limit"),
}
"""Numbers of a PID's settings, by the factor of :func:`factors` that scales them."""


def factors(config: Config) -> dict[str, float]:
    """The environment's puller relative to the default one, on Model I of both [-].

    Its time scale and the inverse; the gains of a PID and of a compensator; the ring's lead coefficient; the heater's
    capacity; the melt temperature that changes growth by v_0.
    """
    default, own = radius_model(make_puller()), model_of(config)
    time, pullers = default.zero / own.zero, [make_puller(each) for each in (parameters_of(config), DEFAULT.parameters)]
    trims = [p.v_0 * p.rho_dH * (p.h_0 + p.layer) / p.k_l for p in pullers]
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
    return radius_model(make_puller(parameters_of(config), 1.0, config.meniscus))


def parameters_of(config: Config) -> Parameters:
    """The puller's own parameters, also where a whole crystal is grown."""
    own: Parameters = labelled(Parameters, config.parameters)
    return own


def scale_pid(settings: Any, config: Config) -> Any:
    """A PID's settings for the default puller, in proportion to the puller of an environment."""
    values = {}
    for name, factor in factors(config).items():
        for path in PROPORTIONAL[name]:
            value = reduce(lambda part, each: getattr(part, each, None), path.split("."), settings)
            if value is not None:
                values[path] = factor * value
    if any(each.sensor.outlier_probability for each in config.scenario.scenarios) and hasattr(settings, "jump"):
        values["jump"] = config.puller.scale * JUMP
    return with_values(settings, values).for_config(config)


def scale_lqg(design: LQGDesign, config: Config) -> LQGDesign:
    """An LQG's design for the default puller, with this one's camera, sensor noise and melt fluctuation.

    Its filter takes the camera to be no better than the file says, and a ripple that it does not track yet for noise:
    an overconfident filter can explain the ring by a wrong meniscus height, and lose the crystal.
    """
    scenario, known = config.scenario.scenarios[0], design.noise
    melt, sensor, drives = scenario.interface, scenario.sensor, scenario.actuators
    fluctuation = _rms(melt.sd) / _rms(RANDOMIZED.interface.sd)
    least, most = known.camera_sd_range
    noise = replace(
        known,
        fast_sd=fluctuation * known.fast_sd,
        slow_sd=fluctuation * known.slow_sd,
        fast_tau=melt.tau_fast,
        slow_tau=melt.tau_slow,
        pyrometer_sd=_rms(sensor.pyrometer_noise) / _rms(RANDOMIZED.sensor.pyrometer_noise) * known.pyrometer_sd,
        camera_sd=max(float(np.hypot(np.mean(sensor.camera_noise), ripple_left(sensor))), least),
        camera_sd_range=(max(sensor.camera_noise[0], least), most),
        heater_walk=known.heater_walk * config.heater_range / DEFAULT.power_range,
        start_radius_sd=max(scenario.pullers.start_radius_sd, known.start_radius_sd),
    )
    noise = expect_errors(noise, config.scenario, make_puller(parameters_of(config)).Q_H_0)
    slack = HEATER_SLACK * drives.heater_step
    design = replace(design, noise=noise, ring=ring_of(sensor), heater_slack=slack, error_pull=None)
    if not (math.isfinite(drives.pull_window) or math.isfinite(drives.pull_slew)):
        return design
    weights = design.weights._replace(pull=max(design.weights.pull, LEAST_PULL))
    error_pull = ERROR_SHARE * min(drives.pull_window, config.parameters.v_0)
    return replace(design, weights=weights, error_pull=error_pull)


def _rms(sd: tuple[float, float]) -> float:
    """Root mean square of a standard deviation that is uniform in a range."""
    low, high = sd
    return float(np.sqrt((low * low + low * high + high * high) / 3.0)) or 1e-3


def scale_crystal(settings: Any, config: Config) -> Any:
    """The settings for the default puller, in proportion to the puller of an environment.

    An LQG's weights follow the ranges of the drives and the meniscus height, the height's walk the growth rate that a
    kelvin makes. Regulators ignore the limits of drives: a step that a slew rate does not allow must be dear, as they
    would swing between the limits otherwise.
    """
    if isinstance(settings, CrystalPID):
        return scale_pid(settings, config)
    own, given, dt = config.ranges, settings.weights, config.control_interval
    here, default = make_puller(parameters_of(config)), make_puller()
    grows = [each.k_l / (each.rho_dH * (each.h_0 + each.layer)) for each in (here, default)]
    noise = settings.noise._replace(height=grows[0] / grows[1] * settings.noise.height)
    pull, power = own[0] / PULL_SCALE, own[1] / HEATER_SCALE
    drives = [each.actuators for each in config.scenario.scenarios]
    weights = given._replace(
        height=here.h_0 / default.h_0 * given.height,
        pull=pull * given.pull,
        pull_step=min(pull * given.pull_step, *(dt * each.pull_slew for each in drives)),
        power=power * given.power,
        power_step=min(power * given.power_step, *(dt * each.heater_slew for each in drives)),
    )
    return replace(settings, noise=noise, weights=weights).for_config(config)
