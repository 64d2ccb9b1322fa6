"""The tuned controllers of whole crystals: a record each.

Their searches meet crowns, bodies and tails, and weigh the largest errors in the crown first: there
the ring misleads most.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np

from cz_gym.config import Config
from cz_gym.crystal.recipe import CONE_LIMIT
from cz_gym.episodes.scenarios import RANDOMIZED
from cz_gym.evaluation.metrics import Floats, crystal_metrics
from cz_gym.evaluation.protocol import Contender
from cz_gym.evaluation.rollout import rollout
from cz_gym.physics.plant import make_puller
from cz_gym.process import HEATER_SCALE, PULL_SCALE
from cz_gym.support.units import HOUR, KILO, MINUTE, MM, MM_PER_MIN

from .crystal import CrystalLQG, CrystalPID, Noise, TrueRadiusPID, Weights
from .pid import SeriesPID, TemperatureLoop
from .tuned import Goal, Parameter, by_scenario, for_puller, with_values
from .tuned_pid import parameters_of, scaled

STAGES = {"crown": 0.6, "body": 0.2, "tail": 0.2}
"""Shares of the stages among the crystals of a search."""
SCENARIOS = {"randomized": 0.5, "hard": 0.5}
"""Shares of the scenarios: on ``hard`` it shows within few crystals which settings lose some."""
WORST = 0.25
"""Share of the crystals, those with the largest errors, whose mean error counts [-]."""
OUTSIDE_PRICE, STEP_PRICE, FAILURE_PRICE = 10.0, 5.0, 100.0
"""Prices of a body that is all off by more than 0.5 mm [mm], of the pull step RMS [mm per mm/min], and of losing every
crystal [mm]."""
HEATER = TemperatureLoop(K=1500.0, T_i=300.0, K_pull=10.0, T_pull=2000.0, T_mean=300.0)
"""The heater's loop on the recipe, trimmed where the mean pull speed is off the recipe's."""
CONVENTIONAL = SeriesPID(K_p=0.0018, T_i=2000.0, T_d=1069.0, N=25.0)
"""Gains of ``pid-conventional`` of ``Cz-v0``, which needs no compensator, with a slower integrator."""
COMPENSATED = SeriesPID(K_p=0.003, T_i=1100.0, T_d=1500.0, N=13.0)
"""A longer derivative than the paper's at a lower gain: from a wider search on training crystals of all stages."""
TRIMMED = TemperatureLoop(K=2200.0, T_i=300.0, K_pull=21.0, T_pull=650.0, T_mean=630.0)
"""The heater's loop with a quicker trim, from the same search."""
LOOP = (
    Parameter("pid.K_p", 3e-4, 5e-2),
    Parameter("pid.T_i", 300.0, 3.0 * HOUR),
    Parameter("pid.T_d", 30.0, 3000.0),
    Parameter("pid.N", 2.0, 100.0),
    Parameter("T_f", 2.0, 300.0),
    Parameter("cone_gain", 0.01, 2.0),
    Parameter("heater.K", 300.0, 3000.0),
    Parameter("heater.K_pull", 1.0, 300.0),
    Parameter("heater.T_pull", 3.0 * MINUTE, 3.0 * HOUR),
    Parameter("heater.T_mean", 10.0, 0.5 * HOUR),
)
COMPENSATOR = (Parameter("lam", 0.0, 1.0, log=False), Parameter("slow", 1e-5, 1e-2))
DESIGN = (
    Parameter("noise.ring", 0.01 * MM, 0.5 * MM),
    Parameter("noise.height", 1e-6, 1e-3),
    Parameter("noise.cones", 0.3, 10.0),
    Parameter("noise.recipe", 0.1, 30.0),
    Parameter("noise.weight", 0.05, 5.0),
    Parameter("noise.mass", 1e-6, 1e-2),
    Parameter("weights.height", 0.03 * MM, 3.0 * MM),
    Parameter("weights.cones", 0.1, 3.0),
    Parameter("weights.pull", 0.01 * MM_PER_MIN, 3.0 * MM_PER_MIN),
    Parameter("weights.power", 0.3 * KILO, 30.0 * KILO),
    Parameter("weights.power_step", 0.1 * KILO, 10.0 * KILO),
)


class CrystalFigures(NamedTuple):
    """Figures of crowns, bodies and tails."""

    crown_mm: float
    """Mean of the crown's largest errors in the :data:`WORST` crystals [mm]."""
    tail_mm: float
    """The same of the tail [mm]."""
    body_outside: float
    """Share of the body's length with an error beyond 0.5 mm [-]."""
    pull_step: float
    """Pull step RMS [mm/min]."""
    failure_rate: float


def measure(policy: Any, config: Config, seeds: Sequence[int]) -> CrystalFigures:
    """Run a controller on those crystals; figures have six digits, as in the history."""
    m = crystal_metrics(rollout(policy, config, seeds))
    inside, steps = np.nanmean(m.body_within_half), m.pull_step_rms_mm_per_min.mean()
    largest = CONE_LIMIT * config.radius_limit / MM
    values = _worst(m.crown_max_mm, largest), _worst(m.tail_max_mm, largest), 1.0 - inside, steps, m.failure_rate.mean()
    return CrystalFigures._make(float(f"{value:.6g}") for value in values)


def _worst(errors: Floats, largest: float) -> float:
    """Mean of the largest errors [mm]; the largest that is allowed where no crystal got there."""
    known = np.sort(errors[~np.isnan(errors)])
    if not len(known):
        return largest
    return float(known[-max(round(WORST * len(known)), 1) :].mean())


def priced(figures: CrystalFigures) -> float:
    """The objective of a search: the largest errors of crown and tail, plus what the rest is worth [mm]."""
    rest = OUTSIDE_PRICE * figures.body_outside + STEP_PRICE * figures.pull_step
    return figures.crown_mm + 0.5 * figures.tail_mm + rest + FAILURE_PRICE * figures.failure_rate


def in_proportion(settings: Any, config: Config) -> Any:
    """The settings for the default puller, in proportion to the puller of an environment.

    An LQG's weights follow the ranges of the drives and the meniscus height, the height's walk the growth rate that a
    kelvin makes. Regulators ignore the limits of drives: a step that a slew rate does not allow must be dear, as they
    would swing between the limits otherwise.
    """
    if isinstance(settings, CrystalPID):
        return scaled(settings, config)
    own, given, dt = config.ranges, settings.weights, config.control_interval
    here, default = make_puller(parameters_of(config)), make_puller()
    grows = [each.k_l / (each.rho_dH * each.h_0) for each in (here, default)]
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


@dataclass(frozen=True, kw_only=True)
class TunedCrystal:
    """A tuned controller of whole crystals: its start, the numbers that were searched, its row in tables."""

    per_parameter: ClassVar[int] = 4
    """Largest number of candidates of a search for a puller, for each parameter."""

    name: str
    meaning: str
    start: CrystalPID | CrystalLQG
    """Settings before the search."""
    parameters: tuple[Parameter, ...]
    quoted: bool = False

    @property
    def settings(self) -> CrystalPID | CrystalLQG:
        """The controller with its tuned settings, on the default puller."""
        settings: CrystalPID | CrystalLQG = with_values(self.start, by_scenario(self.name).get(RANDOMIZED.name, {}))
        return settings

    @property
    def goal(self) -> Goal:
        """The goal of its search."""
        return Goal(self.start, self.parameters, (), priced, (), FAILURE_PRICE, 0.0, CrystalFigures)

    def goal_on(self, config: Config) -> Goal:
        """The goal of its search for the puller of an environment, near the settings in proportion."""
        start = in_proportion(self.settings, config)
        return replace(self.goal, start=start, parameters=tuple(each.near(start) for each in self.parameters))

    def make(self, config: Config) -> CrystalPID | CrystalLQG:
        """The controller for an environment, with the settings that were chosen for its puller, or in proportion."""
        chosen = for_puller(self.name, config.puller)
        settings: CrystalPID | CrystalLQG = with_values(in_proportion(self.settings, config), chosen)
        return settings

    @property
    def contender(self) -> Contender:
        """The controller as a row of the benchmark."""
        return Contender(self.name, self.make, "measured", self.meaning, quoted=self.quoted, on_puller=True)


RING_PID = CrystalPID(pid=CONVENTIONAL, compensates=False, T_f=10.0, heater=HEATER)
TRUE_PID = TrueRadiusPID(pid=SeriesPID(N=10.0), heater=HEATER)
CRYSTALS = (
    TunedCrystal(
        name="ring-pid-reduced",
        meaning="the same with smaller gains in crown and tail",
        start=CrystalPID(pid=CONVENTIONAL, compensates=False, T_f=10.0, cone_gain=0.15, heater=HEATER),
        parameters=LOOP,
    ),
    TunedCrystal(
        name="compensated",
        meaning="PID on the ring less the height that the paper's compensator predicts along the recipe",
        start=CrystalPID(pid=COMPENSATED, lam=0.0, slow=5.0e-4, cone_gain=0.2, T_f=20.0, heater=TRIMMED),
        parameters=(*LOOP, *COMPENSATOR),
        quoted=True,
    ),
    TunedCrystal(
        name="lqg-along",
        meaning="Kalman filters of ring, pyrometer and load cell, and regulators, designed along the recipe",
        start=CrystalLQG(
            noise=Noise(
                ring=8.073e-5,
                weight=0.8,
                height=2.738e-5,
                cones=1.389,
                temperature=2e-3,
                mass=5e-4,
                fluctuation=0.3,
                tau=600.0,
                drift=5.0,
                recipe=4.503,
            ),
            weights=Weights(
                radius=0.4 * MM, height=6.531e-4, cones=0.2566, pull=1.527e-6, power=6488.0, power_step=2646.0
            ),
        ),
        parameters=DESIGN,
        quoted=True,
    ),
)
"""Every tuned controller of whole crystals, in the order of tables."""
