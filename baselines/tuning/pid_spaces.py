"""What may be tuned of each PID controller: parameters, their ranges, and rules that a design must keep."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from cz_gym.baselines.analysis.frequency import crossover, sensitivity
from cz_gym.baselines.analysis.linear_form import linear_form
from cz_gym.baselines.pid.compensated_pid import Compensator, SeriesPID
from cz_gym.baselines.pid.filtered_pid import FilteredPID
from cz_gym.baselines.pid.industrial import Industrial
from cz_gym.baselines.pid.settings import DEFAULT_SCENARIO, settings_of
from cz_gym.baselines.pid.temperature_loop import TemperatureLoop
from cz_gym.errors import CzError
from cz_gym.names import unknown
from cz_gym.physics.linearisation import radius_model
from cz_gym.physics.plant import make_puller
from cz_gym.units import HOUR, MINUTE, MM, MM_PER_MIN

from .harness import Parameter


class Space(NamedTuple):
    """A controller's search."""

    name: str
    base: Any
    """Settings that are not searched, and the first trial."""
    parameters: tuple[Parameter, ...]
    allowed_step: float
    """Mean pull step RMS allowed [m/s]."""
    rule: Callable[[Any], float] = lambda policy: 0.0
    """How far a design breaks the controller's own rule; 0 if it keeps it."""


# More gain than 2 kW/K would help the radius, and shake the heater with the pyrometer's noise.
HEATER = (
    Parameter("heater.K", 300.0, 2000.0),
    Parameter("heater.T_i", 60.0, 0.5 * HOUR),
    Parameter("heater.share", 0.0, 1.0, log=False),
    Parameter("heater.K_pull", 1.0, 100.0),
    Parameter("heater.T_pull", 3.0 * MINUTE, 3.0 * HOUR),
    Parameter("heater.T_mean", 10.0, 0.5 * HOUR),
)
LOOP = (
    Parameter("pid.K_p", 3e-4, 5e-2),
    Parameter("pid.T_i", 300.0, 3.0 * HOUR),
    Parameter("pid.T_d", 30.0, 2000.0),
    Parameter("pid.N", 2.0, 100.0),
    Parameter("T_f", 2.0, 200.0),
    Parameter("T_start", 5.0, 0.5 * HOUR),
    Parameter("ring_lead", -MINUTE, MINUTE, log=False),
    Parameter("K_ff", 0.0, 1.3, log=False),
    *HEATER,
)
COMPENSATOR = (
    Parameter("compensator.gain", -1.0, -0.1, log=False),
    Parameter("compensator.fast", 2e-4, 1e-2),
    Parameter("compensator.slow", 5e-5, 5e-2),
)
ROBUST = (Parameter("T_track", 10.0, HOUR), Parameter("jump", 0.05 * MM, 2.0 * MM))
"""What matters where drives saturate and frames are wrong."""
SENSITIVITY = 2.7
"""Largest peak of the sensitivity function that a tuned loop should have: that of the printed controller [-]."""
SENSITIVITY_PRICE = 0.02
"""Weight of a peak beyond it against a broken rule [-]."""
_NOMINAL = make_puller(lam=1.0), make_puller(lam=0.0)
"""Models I and II."""


def too_sensitive(policy: FilteredPID) -> float:
    """A mild rule, sensitivity peak at most SENSITIVITY: relative excess on the worse nominal model, priced [-]."""
    free, dt = linear_form(policy).free, policy.control_interval
    return SENSITIVITY_PRICE * max(0.0, *(sensitivity(free, each, dt) / SENSITIVITY - 1.0 for each in _NOMINAL))


def over_half_the_zero(policy: FilteredPID) -> float:
    """The paper's rule for a loop with inverse response: crossover at most half the zero; relative excess [-].

    The loop is the sampled one at the nominal Models I and II.
    """
    free, dt = linear_form(policy).free, policy.control_interval
    return max(0.0, *(crossover(free, each, dt) / (0.5 * radius_model(each).zero) - 1.0 for each in _NOMINAL))


_STEP = 0.029 * MM_PER_MIN
_TUNED = FilteredPID(
    pid=SeriesPID(K_p=0.028, T_i=1700.0, T_d=440.0, N=12.0),
    compensator=Compensator(gain=-0.6, fast=1.8e-3, slow=5.3e-3),
    T_f=78.0,
    T_start=190.0,
    T_track=300.0,
    ring_lead=18.0,
    K_ff=1.0,
    heater=TemperatureLoop(K=510.0, T_i=200.0, share=0.52, K_pull=5.8, T_pull=440.0, T_mean=43.0),
)
_CONVENTIONAL = FilteredPID(
    pid=SeriesPID(K_p=1.6e-3, T_i=400.0, T_d=1066.0, N=25.0),
    compensator=None,
    T_f=9.8,
    T_start=600.0,
    T_track=300.0,
    ring_lead=5.0,
    K_ff=0.13,
    heater=TemperatureLoop(K=2000.0, T_i=300.0, share=0.32, K_pull=8.0, T_pull=1000.0, T_mean=380.0),
)
_INDUSTRIAL = Industrial(heater=TemperatureLoop(K_pull=3.0))
SPACES = (
    Space("paper-tuned", _TUNED, (*LOOP, *COMPENSATOR), _STEP, too_sensitive),
    Space("paper-filtered", FilteredPID(), (Parameter("T_f", 2.0, 200.0),), np.inf),
    Space("pid-conventional", _CONVENTIONAL, LOOP, _STEP, lambda one: over_half_the_zero(one) + too_sensitive(one)),
    Space("industrial", _INDUSTRIAL, (Parameter("T_f", 1.0, MINUTE), *HEATER), np.inf),
)
"""Every search."""


def space_of(name: str, scenario: str) -> Space:
    """The search of that controller; limited drives or a faulty camera in the scenario add two parameters.

    On other scenarios than ``randomized`` it begins with the settings frozen for that one. ValueError names the
    controllers that can be tuned.
    """
    for space in SPACES:
        if space.name == name:
            more = ROBUST if scenario in ("puller", "sensor-fault") and isinstance(space.base, FilteredPID) else ()
            base = space.base if scenario == DEFAULT_SCENARIO else settings_of(name, DEFAULT_SCENARIO)
            return space._replace(base=base, parameters=(*space.parameters, *more))
    raise CzError(unknown("controller to tune", name, [space.name for space in SPACES]))
