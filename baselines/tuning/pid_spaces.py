"""What may be tuned of each classical controller: knobs, their ranges, and rules a design must keep."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from cz_gym.baselines.analysis.frequency import crossover, sensitivity
from cz_gym.baselines.analysis.sampled_loop import linear_controller
from cz_gym.baselines.pid.compensated_pid import Compensator, SeriesPID
from cz_gym.baselines.pid.filtered_pid import FilteredPID
from cz_gym.baselines.pid.industrial import Industrial
from cz_gym.baselines.pid.temperature_loop import TemperatureLoop
from cz_gym.baselines.pid.tuned import USUAL, settings
from cz_gym.physics.linearisation import StateSpace, radius_model
from cz_gym.physics.plant import Puller, make_puller
from cz_gym.units import HOUR, MINUTE, MM, MM_PER_MIN


class Knob(NamedTuple):
    """One number of a controller's settings, searched over a range."""

    path: str
    """Where it stands, fields joined by dots."""
    low: float
    high: float
    log: bool = True
    """Whether the range is searched logarithmically."""


class Space(NamedTuple):
    """A controller's search."""

    name: str
    base: Any
    """Settings that no knob turns, and the first trial."""
    knobs: tuple[Knob, ...]
    allowed_step: float
    """Mean pull step RMS allowed [m/s]."""
    rule: Callable[[Any], float]
    """How far a design breaks the controller's own rule; 0 if it keeps it."""


# More gain than 2 kW/K would help the radius, and shake the heater with the pyrometer's noise.
HEATER = (
    Knob("heater.K", 300.0, 2000.0),
    Knob("heater.T_i", 60.0, 0.5 * HOUR),
    Knob("heater.share", 0.0, 1.0, log=False),
    Knob("heater.K_pull", 1.0, 100.0),
    Knob("heater.T_pull", 3.0 * MINUTE, 3.0 * HOUR),
    Knob("heater.T_mean", 10.0, 0.5 * HOUR),
)
LOOP = (
    Knob("pid.K_p", 3e-4, 5e-2),
    Knob("pid.T_i", 300.0, 3.0 * HOUR),
    Knob("pid.T_d", 30.0, 2000.0),
    Knob("pid.N", 2.0, 100.0),
    Knob("T_f", 2.0, 200.0),
    Knob("T_start", 5.0, 0.5 * HOUR),
    Knob("ring_lead", -MINUTE, MINUTE, log=False),
    Knob("K_ff", 0.0, 1.3, log=False),
    *HEATER,
)
COMPENSATOR = (
    Knob("compensator.gain", -1.0, -0.1, log=False),
    Knob("compensator.fast", 2e-4, 1e-2),
    Knob("compensator.slow", 5e-5, 5e-2),
)
ROBUST = (Knob("T_track", 10.0, HOUR), Knob("jump", 0.05 * MM, 2.0 * MM))
"""What matters where drives saturate and readings lie."""


SENSITIVITY = 2.7
"""Largest peak of the sensitivity function a tuned loop should have: that of the printed controller [-]."""
WISH = 0.02
"""Weight of a wish against a rule [-]."""


def nominal_loops(policy: Any) -> tuple[StateSpace, tuple[Puller, Puller]]:
    """The controller without anti-windup, and the nominal Models I and II."""
    free = replace(policy, T_track=np.inf) if isinstance(policy, FilteredPID) else policy
    return linear_controller(free, policy.v_0), (make_puller(lam=1.0), make_puller(lam=0.0))


def unruled(policy: Any) -> float:
    """No rule."""
    return 0.0


def too_sensitive(policy: FilteredPID) -> float:
    """A wish: part of the relative excess of the sensitivity's peak over SENSITIVITY, worse nominal model [-]."""
    controller, pullers = nominal_loops(policy)
    dt = policy.control_interval
    return WISH * max(0.0, *(sensitivity(controller, puller, dt) / SENSITIVITY - 1.0 for puller in pullers))


def over_half_the_zero(policy: FilteredPID) -> float:
    """The paper's rule for a loop with inverse response: crossover at most half the zero, relative excess [-].

    Sampled loop at the nominal Models I and II.
    """
    controller, pullers = nominal_loops(policy)
    found = (crossover(controller, p, policy.control_interval) / (0.5 * radius_model(p).zero) for p in pullers)
    return max(0.0, *(ratio - 1.0 for ratio in found))


def conventional(policy: FilteredPID) -> float:
    """The rule and the wish."""
    return over_half_the_zero(policy) + too_sensitive(policy)


def turned(policy: Any, path: str, value: float) -> Any:
    """The settings with one knob turned; AttributeError if there is no such knob."""
    head, _, rest = path.partition(".")
    inner = getattr(policy, head)
    return replace(policy, **{head: turned(inner, rest, value) if rest else value})


def reading(policy: Any, path: str) -> float:
    """Where a knob stands."""
    for name in path.split("."):
        policy = getattr(policy, name)
    return float(policy)


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
SPACES = (
    Space("paper-tuned", _TUNED, (*LOOP, *COMPENSATOR), _STEP, too_sensitive),
    Space("paper-filtered", FilteredPID(), (Knob("T_f", 2.0, 200.0),), np.inf, unruled),
    Space("pid-conventional", _CONVENTIONAL, LOOP, _STEP, conventional),
    Space(
        "industrial",
        Industrial(heater=TemperatureLoop(K_pull=3.0)),
        (Knob("T_f", 1.0, MINUTE), *HEATER),
        np.inf,
        unruled,
    ),
)
"""Every search."""


def space_of(name: str, scenario: str) -> Space:
    """The search of that controller; scenarios with limited drives or lying cameras open two more knobs.

    On other scenarios than ``randomized`` it begins with the settings frozen for that one. ValueError names the
    controllers that can be tuned.
    """
    for space in SPACES:
        if space.name == name:
            more = ROBUST if scenario in ("puller", "sensor-fault") and isinstance(space.base, FilteredPID) else ()
            base = space.base if scenario == USUAL else settings(name, USUAL)
            return space._replace(base=base, knobs=(*space.knobs, *more))
    raise ValueError(f"nothing to tune for {name!r}; choose from {', '.join(space.name for space in SPACES)}")
