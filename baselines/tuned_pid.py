"""Settings of PIDs in proportion to a puller.

Times follow the zero of G_m, gains the plant's, the temperature loop's the heater's capacity.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, reduce
from typing import Any, ClassVar

from cz_gym.body.process import RadiusModel, radius_model
from cz_gym.config import Config
from cz_gym.episodes.scenario import Scenario
from cz_gym.episodes.scenarios import RANDOMIZED
from cz_gym.jit import labelled
from cz_gym.physics.parameters import Parameters
from cz_gym.physics.plant import Puller, make_puller
from cz_gym.puller.file import DEFAULT
from cz_gym.support.units import HOUR, MINUTE, MM

from .analysis import CUT_OFF, LoopMargins, design_compensator, linear_form, loop_margins
from .pid import FilteredPID, SeriesPID
from .tuned import Figures, Goal, Limit, Parameter, Tuned, beyond, for_puller, for_scenario, with_values

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


# The tuned PIDs: a record each.

# A gain above 2 kW/K would improve the radius, and pass the pyrometer's noise to the heater.
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
"""Parameters for limited drives and faulty cameras."""
QUICK = {"pid.K_p", "pid.T_i", "pid.T_d", "T_f", "compensator.gain", "heater.K", "heater.K_pull", "heater.T_pull"}
"""Parameters that are searched for a puller of the user's own, from the scaled settings."""
SENSITIVITY = 2.7
"""Limit of the sensitivity peak of a tuned loop, that of the printed controller [-]."""
SENSITIVITY_WEIGHT = 0.02
"""Weight of the relative slack of the sensitivity peak [-]."""
STEP, STEP_WEIGHT = 0.029, 10.0
"""Limit of the pull step RMS [mm/min], and the weight of its slack [1/(mm/min)]."""
STEP_PRICE, OUTSIDE_PRICE, FAILURE_PRICE, MISS_PRICE = 0.2, 0.05, 5.0, 2.0
"""Prices of the pull step RMS [mm per mm/min], of a mean pull speed always out of tolerance, of losing every crystal,
and of a broken limit [mm]."""


@lru_cache(maxsize=4)
def margins(policy: FilteredPID) -> list[tuple[LoopMargins, Puller]]:
    """Margins, as of a stable loop, opened at the camera, without anti-windup, on Models I and II of the puller."""
    free, dt = linear_form(policy).free, policy.control_interval
    pullers = [make_puller(policy.parameters, lam, policy.meniscus) for lam in (1.0, 0.0)]
    return [(loop_margins(free, puller, dt, stable=True, points=400), puller) for puller in pullers]


def calm(figures: Figures, policy: FilteredPID) -> float:
    """Slack of the pull steps, weighted [-]."""
    return STEP_WEIGHT * (STEP * policy.v_0 / DEFAULT.parameters.v_0 - figures.pull_step)


def insensitive(figures: Figures, policy: FilteredPID) -> float:
    """Relative slack of the sensitivity peak on the worse of Models I and II, weighted [-]."""
    return SENSITIVITY_WEIGHT * (1.0 - max(loop.sensitivity for loop, _ in margins(policy)) / SENSITIVITY)


def below_half_the_zero(figures: Figures, policy: FilteredPID) -> float:
    """Relative slack of a crossover below half the zero on Models I and II [-]: the paper's rule."""
    zeros = ((loop, radius_model(puller, policy.meniscus).zero) for loop, puller in margins(policy))
    return 1.0 - max(0.0, *(loop.crossover / (0.5 * zero) for loop, zero in zeros))


def priced(figures: Figures) -> float:
    """The objective of a PID's search: observable RMSE plus priced pull steps, mean pull speed and failures [mm]."""
    activity = STEP_PRICE * figures.pull_step + OUTSIDE_PRICE * figures.pull_outside
    return figures.rmse_mm + activity + FAILURE_PRICE * figures.failure_rate


def pid_goal(
    start: Any, parameters: Sequence[Parameter], survive: tuple[str, ...] = (), limits: tuple[Limit, ...] = ()
) -> Goal:
    """Least priced sum within limits."""
    return Goal(start, tuple(parameters), survive, priced, limits, FAILURE_PRICE, MISS_PRICE)


@dataclass(frozen=True, kw_only=True)
class TunedPID(Tuned):
    """A tuned PID."""

    per_parameter: ClassVar[int] = 6

    start: FilteredPID
    """Settings before the search."""
    parameters: tuple[Parameter, ...]
    limits: tuple[Limit, ...] = ()
    hot_zones: bool = False
    """False: a PID tuned without hot zones loses no more crystals there."""

    def settings(self, scenario: Scenario) -> FilteredPID:
        """The controller with its tuned settings for a scenario, on the default puller."""
        settings: FilteredPID = with_values(self.start, for_scenario(self.name, scenario))
        return settings

    def make(self, config: Config) -> FilteredPID:
        """The controller for an environment: tuned for its scenario, or for its puller if that is not the default."""
        if config.puller == DEFAULT or not self.on_puller:
            return self.settings(config.sole_scenario).for_config(config)
        values = for_puller(self.name, config.puller)
        settings: FilteredPID = with_values(scaled(self.settings(RANDOMIZED), config), values)
        return settings

    def goal(self, scenario: Scenario) -> Goal:
        """Its search begins with the settings for ``randomized``."""
        start = self.settings(RANDOMIZED)
        more = ROBUST if beyond(scenario, RANDOMIZED) else ()
        survive = ("hard", "hot-zone") if scenario == RANDOMIZED else ()
        return pid_goal(start, (*self.parameters, *more), survive, self.limits)

    def goal_on(self, config: Config) -> Goal:
        """Its search begins with the scaled settings, and stays near them."""
        start = scaled(self.settings(RANDOMIZED), config)
        near = [each.near(start) for each in self.parameters if each.path in QUICK]
        return pid_goal(start, near, ("hard",), self.limits)


PAPER_TUNED = TunedPID(
    name="paper-tuned",
    meaning="compensator and PID re-tuned, with a slow trim of the heater",
    start=FilteredPID(T_track=300.0),
    parameters=(*LOOP, *COMPENSATOR),
    limits=(calm, insensitive),
    quoted=True,
)
CONVENTIONAL = TunedPID(
    name="pid-conventional",
    meaning="tuned PID without compensator, crossover below half the right-half-plane zero",
    start=FilteredPID(compensator=None, T_track=300.0),
    parameters=LOOP,
    limits=(calm, below_half_the_zero, insensitive),
)
PIDS = (
    TunedPID(
        name="paper-filtered",
        meaning="the paper's controller with a measurement filter and anti-windup",
        start=FilteredPID(),
        parameters=(Parameter("T_f", 2.0, 200.0),),
        on_puller=False,
        searched_on_puller=False,
    ),
    PAPER_TUNED,
    CONVENTIONAL,
)
"""Every tuned PID, in the order of tables."""


def paper_here(config: Config) -> FilteredPID:
    """The paper's controller by its own procedure on this puller's linear model.

    Compensator: the stable part of G_p (1 - G_m) behind a high-pass, whose cut-off lies as far below the zero as the
    paper's. PID: Table 1 with its times in units of the zero's, and the gain that gives the same crossover in units of
    the zero: on the default puller the printed numbers, up to the differences of both linear models. What the paper
    does not say is that of ``paper-tuned`` (measurement filter, anti-windup, heater): with tight drives the printed
    controller winds up.
    """
    tuned: Any = PAPER_TUNED.settings(RANDOMIZED)
    printed = scaled(replace(tuned, pid=SeriesPID(), ring_lead=0.0, K_ff=0.0), config)
    compensator = design_compensator(model_of(config), CUT_OFF / factors(config)["time"])
    controller: FilteredPID = replace(printed, compensator=compensator)
    return controller
