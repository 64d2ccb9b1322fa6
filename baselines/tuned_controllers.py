"""Records of the tuned controllers: PIDs and LQGs of the body, controllers of whole crystals.

PIDs minimise the radius error with a price on activity, within a sensitivity; LQGs the radius error or the reward,
within a pull step RMS. Searches for whole crystals meet crowns, bodies and tails, and weigh the largest errors in the
crown first: there the ring misleads most.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np

from cz_gym.body.process import radius_model
from cz_gym.config import Config
from cz_gym.crystal.recipe import CONE_LIMIT
from cz_gym.episodes.scenario import make_mixture
from cz_gym.episodes.scenarios import HOT_ZONE, RANDOMIZED, find_distribution
from cz_gym.evaluation.metrics import crystal_metrics
from cz_gym.evaluation.rollout import rollout
from cz_gym.physics.plant import Puller, make_puller
from cz_gym.puller.file import DEFAULT
from cz_gym.support.units import HOUR, KILO, MINUTE, MM, MM_PER_MIN

from .analysis import CUT_OFF, LoopMargins, design_compensator, linear_form, loop_margins
from .crystal import CrystalLQG, CrystalNoise, CrystalPID, CrystalWeights, TrueRadiusPID
from .lqg import LQG, LQGDesign
from .lqg_estimator import Hypotheses
from .lqg_filter import NoiseModel
from .margins import MarginLimits
from .pid import FilteredPID, SeriesPID, TemperatureLoop
from .scaling import factors, model_of, scale_crystal, scale_lqg, scale_pid
from .tuned import ANY, OWN_PULLER, TUNED, Objective, Parameter, Scores, TunedController, by_scenario, with_values

# PIDs of the body

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
ON_PULLER = {"pid.K_p", "pid.T_i", "pid.T_d", "T_f", "compensator.gain", "heater.K", "heater.K_pull", "heater.T_pull"}
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


def slack_of_steps(scores: Scores, policy: FilteredPID) -> float:
    """Slack of the pull steps, weighted [-]."""
    return STEP_WEIGHT * (STEP * policy.v_0 / DEFAULT.parameters.v_0 - scores.pull_step)


def slack_of_sensitivity(scores: Scores, policy: FilteredPID) -> float:
    """Relative slack of the sensitivity peak on the worse of Models I and II, weighted [-]."""
    return SENSITIVITY_WEIGHT * (1.0 - max(loop.sensitivity for loop, _ in margins(policy)) / SENSITIVITY)


def below_half_the_zero(scores: Scores, policy: FilteredPID) -> float:
    """Relative slack of a crossover below half the zero on Models I and II [-]: the paper's rule."""
    zeros = ((loop, radius_model(puller, policy.meniscus).zero) for loop, puller in margins(policy))
    return 1.0 - max(0.0, *(loop.crossover / (0.5 * zero) for loop, zero in zeros))


def price(scores: Scores, policy: FilteredPID) -> float:
    """Observable RMSE plus priced pull steps, mean pull speed and failures [mm]: the cost of a PID's search."""
    activity = STEP_PRICE * scores.pull_step + OUTSIDE_PRICE * scores.pull_outside
    return scores.rmse_mm + activity + FAILURE_PRICE * scores.failure_rate


def tuned_pid(limits: tuple[Any, ...], parameters: tuple[Parameter, ...], **facts: Any) -> TunedController:
    """The record of a PID that is searched within limits."""
    objective = Objective(price, limits, FAILURE_PRICE, MISS_PRICE)
    objectives = {
        RANDOMIZED.name: replace(objective, survive=("hard", "hot-zone")),
        ANY: objective,
        OWN_PULLER: replace(objective, survive=("hard",)),
    }
    near = tuple(each for each in parameters if each.path in ON_PULLER)
    settings: dict[str, Any] = {"robust": ROBUST, "near": near, "scale": scale_pid} | facts
    return TunedController(
        objectives=objectives, parameters=parameters, begins_with=RANDOMIZED.name,
        **settings,
    )  # fmt: skip


PAPER_TUNED = tuned_pid(
    (slack_of_steps, slack_of_sensitivity),
    (*LOOP, *COMPENSATOR),
    name="paper-tuned",
    meaning="compensator and PID re-tuned, with a slow trim of the heater",
    start=FilteredPID(T_track=300.0),
    quoted=True,
)
CONVENTIONAL = tuned_pid(
    (slack_of_steps, below_half_the_zero, slack_of_sensitivity),
    LOOP,
    name="pid-conventional",
    meaning="tuned PID without compensator, crossover below half the right-half-plane zero",
    start=FilteredPID(compensator=None, T_track=300.0),
)
PIDS = (
    tuned_pid(
        (),
        (Parameter("T_f", 2.0, 200.0),),
        name="paper-filtered",
        meaning="the paper's controller with a measurement filter and anti-windup",
        start=FilteredPID(),
        near=(),
        scale=None,
        on_puller=False,
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
    printed = scale_pid(replace(tuned, pid=SeriesPID(), ring_lead=0.0, K_ff=0.0), config)
    compensator = design_compensator(model_of(config), CUT_OFF / factors(config)["time"])
    controller: FilteredPID = replace(printed, compensator=compensator)
    return controller


# LQGs of the body

FACTORS = 0.2, 0.6, 1.0
"""Standard deviations of the fluctuations that adaptive LQGs consider possible, in units of the design's own [-]. Above
it the loop is unstable on some hot zones, and its own oscillation then speaks for still stronger fluctuations."""
ACTIVITIES = 0.005, 0.008, 0.013, 0.02, 0.03
"""Largest pull step RMS [mm/min] that the members of the family are tuned for."""
IN_TABLE = 0.02
"""Pull step RMS [mm/min] of the family's member that runs by default: on ``randomized`` the one of least radius error
that moves less than ``paper-tuned``. On a puller of the user's own its filter alone is searched, and the other LQGs
have the same one with their own weights."""
LQG_PARAMETERS = tuple(Parameter(path, 1e-4, 1e4) for path in by_scenario("lqg")[RANDOMIZED.name])
LQG_ON_PULLER = tuple(
    Parameter(path, 0.0, 0.0)
    for path in ("noise.heater_walk", "noise.thermal_walk", "weights.pull", "weights.pull_step", "weights.heater_step")
)
"""Parameters that are searched for a puller: how much the filter doubts the hot zone, and the LQG's activity."""
HALF_HOT_ZONE = make_mixture([(HOT_ZONE, 0.5), (RANDOMIZED, 0.5)])
ALL = find_distribution("all")
"""The crystals that agents learn from."""


def cost_of_lqg(scores: Scores, policy: LQG, rmse_mm: float, by_return: bool) -> float:
    """The return, negative, or the radius error, each about 10, and the price of failures."""
    part = -scores.mean_return / scores.steps if by_return else scores.rmse_mm / (rmse_mm * policy.puller.scale)
    return 10.0 * part + 100.0 * scores.failure_rate


def slack_of_rmse(scores: Scores, policy: LQG, rmse_mm: float) -> float:
    """Relative slack of the observable RMSE [-]; the limit grows with the radius of the puller."""
    return 1.0 - scores.rmse_mm / (rmse_mm * policy.puller.scale)


def slack_of_pull_step(scores: Scores, policy: LQG, pull_step: float) -> float:
    """Relative slack of the pull step RMS [-]."""
    return 1.0 - scores.pull_step / pull_step


def lqg_objective(rmse_mm: float, pull_step: float, by_return: bool, survive: tuple[str, ...] = ()) -> Objective:
    """Maximise the return, or minimise the radius error, within an observable RMSE and a pull step RMS [mm/min]."""
    cost = partial(cost_of_lqg, rmse_mm=rmse_mm, by_return=by_return)
    limits = partial(slack_of_rmse, rmse_mm=rmse_mm), partial(slack_of_pull_step, pull_step=pull_step)
    return Objective(cost, limits, failure_price=100.0, miss_price=20.0, survive=survive)


def tuned_lqg(name: str, meaning: str, limits: dict[str, tuple[float, float]], **facts: Any) -> TunedController:
    """The record of an LQG with a largest RMSE [mm] and pull step RMS [mm/min] for each scenario it is searched on."""
    by_return = facts.pop("by_return", False)
    first = facts.pop("survive", ("hot-zone",) if "hard" in limits else ("hot-zone", "hard"))
    objectives = {
        scenario: lqg_objective(*most, by_return, first if scenario == RANDOMIZED.name else (scenario,))
        for scenario, most in limits.items()
    }
    objectives[OWN_PULLER] = lqg_objective(0.3, 0.02, False)
    settings: dict[str, Any] = {"scale": scale_lqg, "crystals": HALF_HOT_ZONE, "filter_of": FILTER, "candidates": 2}
    settings |= {"start": LQGDesign(), "parameters": LQG_PARAMETERS} | facts
    return TunedController(name=name, meaning=meaning, objectives=objectives, **settings)


def family_name(activity: float) -> str:
    """Name of the LQG tuned for the radius with a pull step RMS [mm/min] of at most ``activity``."""
    return f"lqg-at-{activity:g}"


FILTER = family_name(IN_TABLE)
"""Name of the LQG whose filter is searched on a puller."""
BEST_RETURN = tuned_lqg(
    "lqg",
    "Kalman filter and LQ regulator of pull and heater, for the reward",
    {"randomized": (0.062, 0.02), "puller": (0.09, 0.016), "sensor-fault": (0.063, 0.02)},
    by_return=True,
)
QUIET = tuned_lqg(
    "lqg-quiet",
    "the same for low pull activity",
    {"randomized": (0.075, 0.0095), "puller": (0.1, 0.01), "sensor-fault": (0.076, 0.0095)},
)
MARGINS_MET = with_values(
    LQGDesign(noise=NoiseModel(camera_memory=math.inf)),
    {
        "weights.pull": 2.335, "weights.pull_step": 0.01076, "weights.heater_step": 1039.0,
        "noise.fast_sd": 0.46, "noise.slow_sd": 0.05175, "noise.drift_rate_sd": 0.0002649,
        "noise.drift_rate_tau": 3311.0, "noise.heater_walk": 21.3, "noise.thermal_walk": 0.01163,
        "noise.pyrometer_sd": 0.04286, "noise.recipe_share": 0.1351, "noise.camera_sd": 1.013e-05,
    },
)  # fmt: skip
"""Design within the margins, from random and earlier searches on training crystals: a search that begins outside of
them ends outside. The camera's noise is a constant, since margins change with it."""
LQGS = (
    BEST_RETURN,
    QUIET,
    *(
        tuned_lqg(
            family_name(activity),
            f"the same LQG, tuned for the radius error with pull steps of {activity:g} mm/min at most",
            {each.name: (0.3, activity) for each in TUNED},
            default=activity == IN_TABLE,
            quoted=activity == IN_TABLE,
            filter_of="" if activity == IN_TABLE else FILTER,
            near=LQG_ON_PULLER if activity == IN_TABLE else (),
        )
        for activity in ACTIVITIES
    ),
    tuned_lqg(
        "lqg-one-design",
        "lqg with one design for every scenario: like agents it is not told which one it meets",
        {"randomized": (0.3, 0.02)},
        survive=tuple(each.name for each in ALL.scenarios),
        crystals=ALL,
        by_return=True,
        one_for_all=True,
        quoted=True,
        on_puller=False,
    ),
    tuned_lqg(
        "lqg-robust",
        "lqg with margins: gain 2, phase 30 degrees and sensitivity peak 2 at pull, heater and ring",
        {"randomized": (0.3, 0.03)},
        survive=("hot-zone", "hard"),
        start=MARGINS_MET,
        parameters=(*LQG_PARAMETERS, Parameter("noise.camera_sd", 1e-6, 1e-3)),
        begins_with="start",
        margins=MarginLimits(),
        by_return=True,
        default=False,
        on_puller=False,
    ),
)
"""Every tuned LQG, in the order of tables."""
FAMILY = (QUIET.name, *map(family_name, ACTIVITIES))
"""Names of the LQGs that are tuned for the radius: the reference family of :mod:`cz_gym.evaluation.statistics`."""


def adaptive(plain: LQG) -> LQG:
    """Give an LQG a bank of filters, for FACTORS times its standard deviations of the interface fluctuations."""
    noise = plain.design.noise
    fast, slow = (tuple(factor * sd for factor in FACTORS) for sd in (noise.fast_sd, noise.slow_sd))
    return replace(plain, hypotheses=Hypotheses(fast, slow))


# Controllers of whole crystals

STAGES = {"crown": 0.6, "body": 0.2, "tail": 0.2}
"""Shares of the stages among the crystals of a search."""
CRYSTAL_MIX = {"randomized": 0.5, "hard": 0.5}
"""Shares of the scenarios: on ``hard`` it shows within few crystals which settings lose some."""
WORST = 0.25
"""Share of the crystals, those with the largest errors, whose mean error counts [-]."""
OUTSIDE_BODY_PRICE, CRYSTAL_STEP_PRICE, CRYSTAL_FAILURE_PRICE = 10.0, 5.0, 100.0
"""Prices of a body that is all off by more than 0.5 mm [mm], of the pull step RMS [mm per mm/min], and of losing every
crystal [mm]."""
TRIMMED_HEATER = TemperatureLoop(K=1500.0, T_i=300.0, K_pull=10.0, T_pull=2000.0, T_mean=300.0)
"""The heater's loop on the recipe, trimmed where the mean pull speed is off the recipe's."""
CONE_GAINS = SeriesPID(K_p=0.0018, T_i=2000.0, T_d=1069.0, N=25.0)
"""Gains of ``pid-conventional`` of ``Cz-v0``, which needs no compensator, with a slower integrator."""
COMPENSATED_GAINS = SeriesPID(K_p=0.003, T_i=1100.0, T_d=1500.0, N=13.0)
"""A longer derivative than the paper's at a lower gain: from a wider search on training crystals of all stages."""
QUICK_HEATER = TemperatureLoop(K=2200.0, T_i=300.0, K_pull=21.0, T_pull=650.0, T_mean=630.0)
"""The heater's loop with a quicker trim, from the same search."""
CRYSTAL_LOOP = (
    Parameter("pid.K_p", 3e-4, 5e-2),
    Parameter("pid.T_i", 300.0, 3.0 * HOUR),
    Parameter("pid.T_d", 30.0, 3000.0),
    Parameter("pid.N", 2.0, 100.0),
    Parameter("T_f", 2.0, 300.0),
    Parameter("cone_gain", 0.01, 2.0),
    Parameter("edge_gain", 0.01, 3.0),
    Parameter("heater.K", 300.0, 3000.0),
    Parameter("heater.K_pull", 1.0, 300.0),
    Parameter("heater.T_pull", 3.0 * MINUTE, 3.0 * HOUR),
    Parameter("heater.T_mean", 10.0, 0.5 * HOUR),
)
HEIGHT_MODEL = (Parameter("lam", 0.0, 1.0, log=False), Parameter("slow", 1e-5, 1e-2))
CRYSTAL_DESIGN = (
    Parameter("noise.ring", 0.01 * MM, 0.5 * MM),
    Parameter("noise.edge", 0.03 * MM, 2.0 * MM),
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


class CrystalScores(NamedTuple):
    """Means over crowns, bodies and tails that a candidate is judged by."""

    crown_mm: float
    """Mean of the crown's largest errors in the :data:`WORST` crystals [mm]."""
    tail_mm: float
    """Mean of the tail's largest errors in those crystals [mm]."""
    body_outside: float
    """Share of the body's length with an error beyond 0.5 mm [-]."""
    pull_step: float
    """Pull step RMS [mm/min]."""
    failure_rate: float

    def __str__(self) -> str:
        lost = f"{100 * self.failure_rate:.0f} % lost on validation crystals, half of them hard"
        return f"crown's largest errors {self.crown_mm:.2f} mm, tail's {self.tail_mm:.2f} mm, {lost}"


def measure_crystals(policy: Any, config: Config, seeds: Sequence[int]) -> CrystalScores:
    """Run a controller on those crystals; scores have six digits, as in the history."""
    m = crystal_metrics(rollout(policy, config, seeds))
    worst = []
    for errors in (m.crown_max_mm, m.tail_max_mm):
        known = np.sort(errors[~np.isnan(errors)])
        # The largest error that is allowed, where no crystal got there.
        mean = (
            known[-max(round(WORST * len(known)), 1) :].mean() if len(known) else CONE_LIMIT * config.radius_limit / MM
        )
        worst.append(float(mean))
    inside, steps = np.nanmean(m.body_within_half), m.pull_step_rms_mm_per_min.mean()
    values = *worst, 1.0 - inside, steps, m.failure_rate.mean()
    return CrystalScores._make(float(f"{value:.6g}") for value in values)


def price_crystals(scores: CrystalScores, policy: Any) -> float:
    """The largest errors of crown and tail, plus what the rest is worth [mm]: the cost of a search."""
    rest = OUTSIDE_BODY_PRICE * scores.body_outside + CRYSTAL_STEP_PRICE * scores.pull_step
    return scores.crown_mm + 0.5 * scores.tail_mm + rest + CRYSTAL_FAILURE_PRICE * scores.failure_rate


CRYSTAL_OBJECTIVE = Objective(
    price_crystals, (), CRYSTAL_FAILURE_PRICE, miss_price=0.0, kind=CrystalScores, measure=measure_crystals
)


def tuned_crystal(parameters: tuple[Parameter, ...], **facts: Any) -> TunedController:
    """The record of a controller of whole crystals: one search for every scenario, near settings for another puller."""
    return TunedController(
        parameters=parameters, near=parameters, scale=scale_crystal, begins_with="start", one_for_all=True,
        objectives={RANDOMIZED.name: CRYSTAL_OBJECTIVE, OWN_PULLER: CRYSTAL_OBJECTIVE},
        crystals=find_distribution(CRYSTAL_MIX), crystals_on_puller=CRYSTAL_MIX, stages=STAGES,
        candidates=4, episodes=60, **facts,
    )  # fmt: skip


RING_PID = CrystalPID(pid=CONE_GAINS, compensates=False, T_f=10.0, heater=TRIMMED_HEATER)
TRUE_PID = TrueRadiusPID(pid=SeriesPID(N=10.0), heater=TRIMMED_HEATER)
CRYSTALS = (
    tuned_crystal(
        CRYSTAL_LOOP,
        name="ring-pid-reduced",
        meaning="the same with smaller gains in crown and tail",
        start=CrystalPID(pid=CONE_GAINS, compensates=False, T_f=10.0, cone_gain=0.15, heater=TRIMMED_HEATER),
    ),
    tuned_crystal(
        (*CRYSTAL_LOOP, *HEIGHT_MODEL),
        name="compensated",
        meaning="PID on the edge, or on the ring less the height that the paper's compensator predicts",
        start=CrystalPID(pid=COMPENSATED_GAINS, lam=0.0, slow=5.0e-4, cone_gain=0.2, T_f=20.0, heater=QUICK_HEATER),
        quoted=True,
    ),
    tuned_crystal(
        CRYSTAL_DESIGN,
        name="lqg-along",
        meaning="Kalman filters of ring, edge, pyrometer and load cell, and regulators, designed along the recipe",
        start=CrystalLQG(
            noise=CrystalNoise(
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
            weights=CrystalWeights(
                radius=0.4 * MM, height=6.531e-4, cones=0.2566, pull=1.527e-6, power=6488.0, power_step=2646.0
            ),
        ),
        quoted=True,
    ),
)
"""Every tuned controller of whole crystals, in the order of tables."""
