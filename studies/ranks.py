"""Ranks of controllers under the plant's estimates, and what any of them could reach: ``python -m studies.ranks``.

Each estimate is moved alone, on the same crystals, with the controllers and agents of README's plot as they are.
Kendall's tau compares their order, by crystals lost and then by cost, with that of ``randomized``. The limit is the
error of the best linear controller on the linear plant, told all of it, that moves the pull as much.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import solve_discrete_are
from scipy.optimize import brentq
from scipy.stats import kendalltau

from cz_gym.baselines.lqg_filter import DRIFT, NoiseModel, plant_model
from cz_gym.body.process import OUTPUTS, linearise, radius_model
from cz_gym.config import Config
from cz_gym.episodes.scenario import Interface, Scenario, Sensor
from cz_gym.episodes.scenarios import MELT_LAYER, RANDOMIZED, RANDOMIZED_TRACED
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.plots import MARKS, canvas, png, styles
from cz_gym.evaluation.protocol import TEST_SEEDS
from cz_gym.evaluation.rollout import rollout
from cz_gym.physics.parameters import Parameters
from cz_gym.physics.plant import Puller, make_puller
from cz_gym.support.command_line import between
from cz_gym.support.files import write_files
from cz_gym.support.units import KILO, MM, MM_PER_MIN
from cz_gym.tools.report.tables import markdown

from . import StudyParser
from .robustness import policy_and_config

CONTROLLERS = ("paper", "paper-filtered", "paper-tuned", "lqg", "lqg-at-0.02", "lqg-one-design", "gradient", "ppo",
               "sac", "ppo-plain")  # fmt: skip
"""Controllers of README's plot, and agents by their seed of least validation cost."""
FLUCTUATION, CAMERA, PYROMETER = 0.29, 0.029 * MM, 0.058
"""Root mean squares of each fluctuation [K], of the camera's [m] and of the pyrometer's noise [K] on ``randomized``."""
FIXED = Scenario(
    "noise alone",
    interface=Interface(sd=(FLUCTUATION, FLUCTUATION)),
    sensor=Sensor(camera_noise=(CAMERA, CAMERA), pyrometer_noise=(PYROMETER, PYROMETER)),
)
"""Conditions of the limit: fluctuations and noise of these sizes, a puller that is known, nothing else."""
MIX = 0.5
NOISES = (0.005 * MM, 0.015 * MM, CAMERA, 0.06 * MM, 0.12 * MM)
GAINS = (0.25, 0.5, 1.0, 2.0, 4.0)
"""Factors on the ring's gain to the meniscus height: the zero moves inversely."""
ACTIVITY = 0.02 * MM_PER_MIN
"""Pull step RMS of the regulator of the table of limits [m/s]: that of ``lqg-at-0.02``."""
CHEAPEST, DEAREST = -4.0, 4.0
"""Decimal logarithms of the least and the largest price of the regulator's moves: at the least, more moves gain
nothing."""
HELD = 1e-4
"""Price of the drives' squares [1/(mm/min)^2, 1/kW^2]: what returns them to nominal."""


class Variant(NamedTuple):
    """The plant and its disturbances with one estimate moved."""

    about: str
    scenario: Scenario = RANDOMIZED
    parameters: Parameters = Parameters()


def variants() -> list[Variant]:
    """Every estimate, moved alone."""
    drawn, sway = RANDOMIZED.pullers, RANDOMIZED.interface

    def interface(**changes: Any) -> Scenario:
        return replace(RANDOMIZED, interface=replace(sway, **changes))

    def pullers(**changes: Any) -> Scenario:
        return replace(RANDOMIZED, pullers=replace(drawn, **changes))

    return [
        Variant("as `randomized`"),
        *(Variant(f"each fluctuation {sd:g} K", interface(sd=(sd, sd))) for sd in (0.25, 0.5, 1.0, 2.0)),
        *(
            Variant(f"correlation times x {factor:g}",
                    interface(tau_fast=factor * sway.tau_fast, tau_slow=factor * sway.tau_slow))
            for factor in (0.25, 4.0)
        ),
        *(Variant(f"T_e {T_e:g} K", parameters=Parameters(T_e=T_e)) for T_e in (1150.0, 1450.0)),
        *(Variant(f"dT_0 {dT_0:g} K", parameters=Parameters(dT_0=dT_0)) for dT_0 in (2.5, 10.0)),
        *(Variant(f"conductances x {by:g}", pullers(conductance_factor=(by, by))) for by in (0.6, 1.6)),
        *(Variant(f"capacities x {by:g}", pullers(capacity_factor=(by, by), melt_capacity_factor=(by, by)))
          for by in (0.6, 1.6)),
        Variant("R 2e-4 m²K/W", pullers(boundary_layer=(2e-4, 2e-4))),
        Variant("R 7e-4 m²K/W (`melt-layer`)", MELT_LAYER),
        Variant("traced ring (`randomized-traced`)", RANDOMIZED_TRACED),
        *(Variant(f"phi_b {deg:g} deg", pullers(ring_slope=float(np.radians(deg)))) for deg in (2.0, 7.0)),
    ]  # fmt: skip


def errors(policy: Any, designed_for: Config, scenario: Scenario, parameters: Parameters, crystals: int) -> Any:
    """The metrics of a controller on crystals of a moved plant."""
    config = replace(designed_for, scenario=scenario, parameters=parameters)
    return metrics(rollout(policy, config, TEST_SEEDS[:crystals], designed_for=designed_for))


# The limit


class LinearLoop(NamedTuple):
    """The plant in mm, K, mm/min and kW, its filter and its regulator, for one control interval."""

    A: Any
    B: Any
    H: Any
    Q: Any
    R: Any
    learns: Any
    """From innovations to states."""
    posterior: Any
    """Covariance of the estimate after a sample."""
    S: Any
    """Covariance of the innovations."""
    F: Any
    """From states and last drives to moves, which are subtracted."""


def linear_loop(puller: Puller, camera: float, gain: float, price: float, dt: float = 5.0) -> LinearLoop:
    """The best linear controller that knows the plant.

    ``camera`` is the ring's noise [m], ``gain`` multiplies the ring's gain to the height, ``price`` is that of the
    drives' squared steps [mm2/(mm/min)2, mm2/kW2].
    """
    noise = NoiseModel(fast_sd=FLUCTUATION, slow_sd=FLUCTUATION, thermal_walk=0.0)
    model, known, drives = plant_model(puller, noise, dt), DRIFT, np.array([MM_PER_MIN, KILO])
    size = np.array([MM, MM, *[1.0] * (known - 2)])
    A, Q = model.A[:known, :known] * np.outer(1.0 / size, size), model.Q[:known, :known] / np.outer(size, size)
    H = model.H[:, :known] * size / np.array([[MM], [1.0]])
    H[0, 1] *= gain
    R = np.diag([(camera / MM) ** 2, PYROMETER**2])
    prior = solve_discrete_are(A.T, H.T, Q + 1e-12 * np.eye(known), R)
    S = H @ prior @ H.T + R
    learns = prior @ H.T @ np.linalg.inv(S)
    posterior = prior - learns @ H @ prior
    # The regulator moves the drives [mm/min, kW], which the state holds: squares of the radius [mm] and priced moves.
    B = model.B[:known] * drives / size[:, None]
    whole, moves = np.block([[A, B], [np.zeros((2, known)), np.eye(2)]]), np.vstack([B, np.eye(2)])
    cost = np.diag([1.0, *[0.0] * (known - 1), HELD, HELD])
    law = solve_discrete_are(whole, moves, cost, price * np.eye(2))
    F = np.linalg.solve(price * np.eye(2) + moves.T @ law @ moves, moves.T @ law @ whole)
    return LinearLoop(A, B, H, Q, R, learns, posterior, S, F)


def linear_error(puller: Puller, camera: float, gain: float, price: float) -> tuple[float, float]:
    """Stationary radius error [m] and pull step [m/s], RMS, of that loop.

    The estimate errs by the filter's covariance; the regulator's state moves by what the filter learns at every sample.
    """
    loop = linear_loop(puller, camera, gain, price)
    known = len(loop.A)
    moves = np.vstack([loop.B, np.eye(2)])
    whole = np.block([[loop.A, loop.B], [np.zeros((2, known)), np.eye(2)]]) - moves @ loop.F
    enters = np.vstack([loop.learns, np.zeros((2, 2))])
    state = _stationary(whole, enters @ loop.S @ enters.T)
    error = np.sqrt(state[0, 0] + loop.posterior[0, 0])
    return float(MM * error), float(MM_PER_MIN * np.sqrt(loop.F[0] @ state @ loop.F[0]))


def _stationary(A: Any, Q: Any) -> Any:
    """Covariance of x_{k+1} = A x_k + w_k, by doubling the number of steps: exact where A is stable."""
    while np.abs(A).max() > 1e-12:
        Q, A = Q + A @ Q @ A.T, A @ A
    return Q


def limit(puller: Puller, camera: float, gain: float = 1.0, activity: float = ACTIVITY) -> float:
    """Least error [m] at this noise of the camera [m] with pull steps of at most ``activity`` [m/s], RMS."""

    def excess(exponent: float) -> float:
        return float(np.log(linear_error(puller, camera, gain, 10.0**exponent)[1] / activity))

    price = CHEAPEST if excess(CHEAPEST) <= 0.0 else brentq(excess, CHEAPEST, DEAREST, xtol=1e-3)
    return linear_error(puller, camera, gain, 10.0**price)[0]


def zero_of(gain: float) -> float:
    """Right-half-plane zero [rad/s] of a ring whose gain to the height is that many times the default puller's."""
    puller = make_puller(lam=MIX)
    A, C = linearise(puller).A, linearise(puller).C[OUTPUTS.index("r_br")]
    assert np.isclose(radius_model(puller).zero, C[0] * A[0, 1] / C[1] * -1.0 + A[0, 0])
    return float(A[0, 0] - C[0] * A[0, 1] / (gain * C[1]))


# What is written


def places(found: Mapping[str, Any]) -> list[int]:
    """The place of each controller, as the README ranks: by crystals lost, then by cost."""
    keys = [(each.failure_rate.sum(), each.cost.mean()) for each in found.values()]
    return [sorted(keys).index(key) for key in keys]


def ranked(moved: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, ...]]:
    """Rows of the table: variant, tau, errors [mm], lost crystals."""
    base, rows = places(next(iter(moved.values()))), []
    for about, found in moved.items():
        here, tau = [each.rmse_mm.mean() for each in found.values()], kendalltau(base, places(found)).statistic
        lost = [f"{name} {int(each.failure_rate.sum())}" for name, each in found.items() if each.failure_rate.any()]
        rows.append((about, f"{tau:.2f}", *(f"{error:.3f}" for error in here), ", ".join(lost) or "none"))
    return rows


def figure(moved: Mapping[str, Mapping[str, Any]]) -> bytes:
    """Draw the radius error of each controller under each moved estimate, lost crystals as large errors."""
    drawing, abouts = canvas(8.0, 4.6), list(moved)
    axes, looks = drawing.add_subplot(), styles(list(next(iter(moved.values()))))
    for name, look in looks.items():
        values = [found[name].rmse_mm.mean() for found in moved.values()]
        drawn: Any = {"color": look.colour, "marker": MARKS[look.mark], "ls": (0, look.dashes) if look.dashes else "-"}
        axes.semilogy(range(len(abouts)), values, ms=5, lw=0.8, label=name, **drawn)
    axes.set_xticks(range(len(abouts)), [each.replace("`", "") for each in abouts], rotation=60, ha="right")
    axes.set_ylabel("radius error [mm]")
    axes.legend(fontsize=7, ncols=3, frameon=False)
    return png(drawing)


def limits_table() -> str:
    """The limit against the zero's place and the camera's noise, a Markdown table."""
    puller = make_puller(lam=MIX)
    heads = "zero [rad/s]", *(f"camera {1e3 * noise / MM:g} µm" for noise in NOISES)
    rows = [(f"{zero_of(gain):.4f}", *(f"{limit(puller, noise, gain) / MM:.4f}" for noise in NOISES)) for gain in GAINS]
    return markdown(heads, rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = StudyParser("ranks", __doc__, "results/ranks")
    parser.add_argument("controllers", nargs="*", help=f"names ({', '.join(CONTROLLERS)})")
    parser.add_argument("--crystals", type=between(1, 500), default=100, help="number of test crystals (%(default)s)")
    return parser.run(_main, arguments)


def _main(given: argparse.Namespace) -> None:
    names, moved = given.controllers or CONTROLLERS, dict[str, dict[str, Any]]()
    policies = {name: policy_and_config(name, "randomized", 3.0) for name in names}
    for each in variants():
        moved[each.about] = {
            name: errors(*policies[name], each.scenario, each.parameters, given.crystals) for name in names
        }
        print(*ranked(moved)[-1], flush=True)
    puller, distance = make_puller(lam=MIX), []
    for name in names:
        designed_for = replace(policies[name][1], model=MIX)
        found = errors(policies[name][0], designed_for, FIXED, Parameters(), given.crystals)
        error, step = found.rmse_mm.mean(), found.pull_step_rms_mm_per_min.mean()
        least = limit(puller, CAMERA, activity=step * MM_PER_MIN) / MM
        distance.append((name, f"{step:.4f}", f"{error:.4f}", f"{least:.4f}", f"{error / least:.2f}"))
    text = f"""# Ranks under the plant's estimates

Radius error (RMSE) [mm] on {given.crystals} test crystals of three hours, one estimate moved at a time; the controllers
stay as they are on `randomized`. A lost crystal counts 8 mm to its end. Kendall's tau compares the order, by crystals
lost and then by cost, with that of the first row: 1 is the same order, 0 no relation. Two controllers that hold nearly
alike may change places by chance: each such pair lowers tau by {4.0 / max(len(names) * (len(names) - 1), 1):.2f}. An
agent is its training seed of least validation cost.

{markdown(("estimate", "tau", *names, "lost"), ranked(moved))}

![Errors under moved estimates](ranks.png)

## The limit

Least stationary radius error [mm] of a linear controller that knows the plant (half conduction, no layer) and meets
nothing but two fluctuations of {FLUCTUATION:g} K and the noise of camera and pyrometer. Here its pull steps are
{ACTIVITY / MM_PER_MIN:g} mm/min RMS. The ring's gain to the height moves the zero, which is at {zero_of(1.0):.4f} rad/s
by default:

{limits_table()}

Each controller on such crystals, with {1e3 * CAMERA / MM:g} µm of camera noise, beside the limit for pull steps as
large as its own: one that moves less has a larger error for that alone.

{markdown(("controller", "pull step RMS [mm/min]", "error [mm]", "limit [mm]", "times the limit"), distance)}
"""
    write_files({given.out / "table.md": text.encode(), given.out / "ranks.png": figure(moved)})


if __name__ == "__main__":
    sys.exit(main())
