"""Settings of PIDs in proportion to a puller.

Times follow the zero of G_m, gains the plant's, the temperature loop's the heater's capacity.
"""

from functools import reduce
from typing import Any

from cz_gym.baselines.analysis.compensator_design import CUT_OFF, design_compensator
from cz_gym.body.linearisation import RadiusModel, radius_model
from cz_gym.body.plant import make_puller
from cz_gym.config import Config
from cz_gym.jit.compile import labelled
from cz_gym.machine.puller import DEFAULT
from cz_gym.physics.parameters import Parameters
from cz_gym.support.units import MM

from .values import with_values

JUMP = 1.0 * MM
"""Largest difference of reading and filter that counts on the default puller, where outliers are to be expected [m]."""
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
    trims = [p.v_0 * p.rho_dH * p.h_0 / p.k_l for p in pullers]
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


def scaled(settings: Any, config: Config) -> Any:
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
