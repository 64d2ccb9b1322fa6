"""The goals of all searches: parameters, ranges, prices and rules of each controller."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

from cz_gym.baselines import for_puller
from cz_gym.baselines.analysis.frequency import LoopMargins, loop_margins
from cz_gym.baselines.analysis.linear_form import linear_form
from cz_gym.baselines.lqg.controller import LQGDesign
from cz_gym.baselines.lqg.designs import ACTIVITIES, SHIPPED, TOLD, design_of, family_name
from cz_gym.baselines.pid.filtered_pid import FilteredPID
from cz_gym.baselines.pid.settings import settings_of
from cz_gym.baselines.tuned_for import beyond, shipped
from cz_gym.body.linearisation import radius_model
from cz_gym.body.plant import Puller, make_puller
from cz_gym.config import Config, make_config
from cz_gym.episodes.mixture import Distribution, make_mixture
from cz_gym.episodes.scenario import Scenario
from cz_gym.episodes.scenarios import HOT_ZONE, RANDOMIZED
from cz_gym.errors import CzError
from cz_gym.machine.puller import DEFAULT, PullerFile
from cz_gym.support.names import unknown
from cz_gym.support.units import HOUR, MINUTE, MM

from .search import Figures, Goal, Parameter, Search, Trial, measure, value_at

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
SENSITIVITY = 2.7
"""Limit of the sensitivity peak of a tuned loop, that of the printed controller [-]."""
SENSITIVITY_WEIGHT = 0.02
"""Weight of the relative slack of the sensitivity peak [-]."""
STEP, STEP_WEIGHT = 0.029, 10.0
"""Limit of the pull step RMS [mm/min], and the weight of its slack [1/(mm/min)]."""


@lru_cache(maxsize=4)
def margins(policy: FilteredPID) -> list[tuple[LoopMargins, Puller]]:
    """Margins of the sampled loop opened at the camera, without anti-windup, on Models I and II of the puller.

    They are those of a stable loop, whether it is stable or not.
    """
    free, dt = linear_form(policy).free, policy.control_interval
    pullers = [make_puller(policy.parameters, lam, policy.meniscus) for lam in (1.0, 0.0)]
    return [(loop_margins(free, puller, dt, stable=True, points=400), puller) for puller in pullers]


def calm(found: Figures, policy: FilteredPID) -> float:
    """Slack of the pull steps, weighted [-]."""
    return STEP_WEIGHT * (STEP * policy.v_0 / DEFAULT.parameters.v_0 - found.pull_step)


def insensitive(found: Figures, policy: FilteredPID) -> float:
    """Relative slack of the sensitivity peak on the worse of Models I and II, weighted [-]."""
    return SENSITIVITY_WEIGHT * (1.0 - max(loop.sensitivity for loop, _ in margins(policy)) / SENSITIVITY)


def below_half_the_zero(found: Figures, policy: FilteredPID) -> float:
    """Relative slack of the crossover below half the zero on Models I and II [-]: the paper's rule without compensator.

    Where the gain never falls through one, the rule is kept.
    """
    zeros = ((loop, radius_model(puller, policy.meniscus).zero) for loop, puller in margins(policy))
    return 1.0 - max(0.0, *(loop.crossover / (0.5 * zero) for loop, zero in zeros))


PIDS: dict[str, dict[str, Any]] = {
    "paper-tuned": {"parameters": (*LOOP, *COMPENSATOR), "limits": (calm, insensitive)},
    "paper-filtered": {"parameters": (Parameter("T_f", 2.0, 200.0),)},
    "pid-conventional": {"parameters": LOOP, "limits": (calm, below_half_the_zero, insensitive)},
    "industrial": {"parameters": (Parameter("T_f", 1.0, MINUTE), *HEATER)},
}
"""Parameters and limits of the PIDs, as arguments of :func:`pid_goal`."""


STEP_PRICE, FAILURE_PRICE, MISS_PRICE = 0.2, 5.0, 2.0
"""Prices of the pull step RMS [mm per mm/min], of losing every crystal, and of a broken limit [mm]."""


def priced(found: Figures) -> float:
    """What a PID's search minimises: observable RMSE plus priced pull steps and failures [mm]."""
    return found.rmse_mm + STEP_PRICE * found.pull_step + FAILURE_PRICE * found.failure_rate


def pid_goal(start: Any, parameters: tuple[Parameter, ...], survive: tuple[str, ...], limits: Any = ()) -> Goal:
    """Least priced sum within limits."""
    return Goal(start, parameters, survive, priced, limits, FAILURE_PRICE, MISS_PRICE)


def lqg_goal(
    start: LQGDesign,
    parameters: tuple[Parameter, ...],
    survive: tuple[str, ...],
    rmse_mm: float,
    pull_step: float,
    by_return: bool,
) -> Goal:
    """Most return, or least radius error, within an observable RMSE [mm] and a pull step RMS [mm/min]; of order ten."""

    def objective(found: Figures) -> float:
        cost = -found.mean_return / found.steps if by_return else found.rmse_mm / rmse_mm
        return 10.0 * cost + 100.0 * found.failure_rate

    limits = (lambda found, _: 1.0 - found.rmse_mm / rmse_mm, lambda found, _: 1.0 - found.pull_step / pull_step)
    return Goal(start, parameters, survive, objective, limits, failure_price=100.0, miss_price=20.0)


LQG_PARAMETERS = tuple(Parameter(path, 1e-4, 1e4) for path in shipped("lqg")["randomized"])
FAMILY_SCENARIOS = "randomized", "hard", "sensor-fault", "puller"
"""Scenarios on which the family has members of its own."""
LQG_LIMITS: dict[tuple[str, str], tuple[float, float, bool]] = {
    ("lqg", "randomized"): (0.062, 0.02, True),
    ("lqg", "puller"): (0.09, 0.016, True),
    ("lqg", "sensor-fault"): (0.063, 0.02, True),
    ("lqg-quiet", "randomized"): (0.075, 0.0095, False),
    ("lqg-quiet", "puller"): (0.1, 0.01, False),
    ("lqg-quiet", "sensor-fault"): (0.076, 0.0095, False),
    **{(family_name(each), name): (0.3, each, False) for name in FAMILY_SCENARIOS for each in ACTIVITIES},
    (TOLD, "randomized"): (0.3, 0.02, False),
}
"""Last three arguments of :func:`lqg_goal`, by controller and scenario."""


NOMINAL = (TOLD, "paper-filtered", "paper-tuned", "pid-conventional")
"""Controllers searched on ``randomized`` without ``hot-zone``; these PIDs lose no more crystals there all the same."""


def crystals(name: str, scenario: Scenario) -> Distribution:
    """The crystals on which candidates are scored: for ``randomized`` half of them are of ``hot-zone``."""
    mixed = scenario == RANDOMIZED and name not in NOMINAL
    return make_mixture([(HOT_ZONE, 0.5), (RANDOMIZED, 0.5)]) if mixed else scenario


QUICK = {"pid.K_p", "pid.T_i", "pid.T_d", "T_f", "compensator.gain", "heater.K", "heater.K_pull", "heater.T_pull"}
"""Parameters of a PID that are searched for a puller of the user's own, from its scaled settings."""
FILTER_PARAMETERS = (
    "noise.heater_walk",
    "noise.thermal_walk",
    "weights.pull",
    "weights.pull_step",
    "weights.heater_step",
)
"""The same of an LQG: how much its filter doubts the hot zone, and its activity."""
NEAR = 8.0
"""How far, as a factor, a search for a puller goes from the scaled settings [-]."""


def goal_on(name: str, config: Config) -> Goal:
    """The goal of a controller's search for a puller of the user's own; CzError if there is none."""
    if name == for_puller.FILTER:
        design = for_puller.scaled_design(name, config)
        near = tuple(_near(Parameter(path, 0.0, 0.0), design) for path in FILTER_PARAMETERS)
        return lqg_goal(design, near, (), 0.3 * config.puller.scale, 0.02, False)
    if name not in for_puller.PIDS:
        raise CzError(unknown("controller to tune for a puller", name, [*for_puller.PIDS, for_puller.FILTER]))
    start, given = for_puller.scaled_pid(name, config), PIDS[name]
    near = tuple(_near(each, start) for each in given["parameters"] if each.path in QUICK)
    return pid_goal(start, survive=("hard",), **given | {"parameters": near})


def _near(parameter: Parameter, start: Any) -> Parameter:
    """The parameter with a range around where the search begins."""
    value = value_at(start, parameter.path)
    return parameter._replace(low=value / NEAR, high=value * NEAR) if parameter.log else parameter


def crystals_on(puller: PullerFile) -> Config:
    """The crystals that controllers are designed on for a puller: half of them with other hot zones."""
    mixed = {"randomized": 0.5, "hot-zone": 0.5}
    return make_config(mixed, None, "measured", action="direct", puller=puller)


def search_for(task: tuple[str, PullerFile, int, int, Path]) -> Trial:
    """One search for a puller: controller, puller, candidates, episodes and folder."""
    name, puller, trials, episodes, folder = task
    config = crystals_on(puller)
    return Search(name, goal_on(name, config), config, trials, episodes, measure, True).tune(folder / f"{name}.json")


TUNABLE = (*PIDS, *SHIPPED)
"""Names of the controllers that can be tuned."""


def goal_of(name: str, scenario: Scenario) -> Goal:
    """The goal of a controller's search on a scenario; CzError if there is none.

    A PID's search begins with the settings for ``randomized``, an LQG's with the design that ships for the scenario.
    """
    if name not in TUNABLE:
        raise CzError(unknown("controller to tune", name, TUNABLE))
    if name in PIDS:
        start, given = settings_of(name, RANDOMIZED), PIDS[name]
        more = ROBUST if beyond(scenario, RANDOMIZED) and isinstance(start, FilteredPID) else ()
        survive = ("hard", "hot-zone") if scenario == RANDOMIZED else ()
        return pid_goal(start, survive=survive, **given | {"parameters": (*given["parameters"], *more)})
    if (name, scenario.name) not in LQG_LIMITS:
        known = ", ".join(where for each, where in LQG_LIMITS if each == name)
        raise CzError(f"{name} has no goal on {scenario.name!r}, but on {known}")
    serves_hard = name in ("lqg", "lqg-quiet") and scenario == RANDOMIZED
    survive = (crystals(name, scenario).scenarios[0].name, *(("hard",) if serves_hard else ()))
    return lqg_goal(design_of(name, scenario), LQG_PARAMETERS, survive, *LQG_LIMITS[name, scenario.name])
