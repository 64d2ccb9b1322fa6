"""The paper's experiments on the nonlinear plant, each a run of the environment turned into signals against time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm

from cz_gym import HURLE, MeniscusModel, Scenario, make_puller
from cz_gym.baselines.policy import batched, to_action
from cz_gym.config import make_config
from cz_gym.episodes.schedule import quintic
from cz_gym.evaluation.rollout import Signals, rollout
from cz_gym.physics.linearisation import OUTPUTS, linearise
from cz_gym.units import HOUR, MINUTE

Floats = npt.NDArray[np.float64]
MODELS = {"I": 1.0, "II": 0.0}
"""Share of conduction of the paper's models [-]."""
INTERVAL = 5.0
"""Time between actions in closed loop [s]."""
FINE = 1.0
"""Time between actions in open loop [s]."""


@dataclass(frozen=True)
class PullSchedule:
    """Pull speed by the clock, heater at its nominal power; ``share[k]`` is v_p / v_0 - 1 during step k."""

    share: tuple[float, ...]

    def predict(
        self, observation: Any, state: int | None = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[npt.NDArray[np.float32], int]:
        """The schedule's next entry, whatever is observed."""
        array, single = batched(observation)
        k = state or 0
        pull = np.full(len(array), self.share[k])
        return to_action(pull, np.zeros(len(array)), single), k + 1


class Trace(NamedTuple):
    """One episode from t = 0 until its end, arrays of shape (samples,)."""

    t: Floats
    """Time [s]."""
    signals: Signals
    """Logged signals, SI units, radians."""
    r_tilde: Floats
    """Ring minus bias plus compensator [m]; without a compensator, ring minus bias."""
    failed: bool
    """Whether the episode ended in a failure."""


def trace(
    policy: Any,
    model: str,
    scenario: str | Scenario = "nominal",
    horizon: float = 3.0 * HOUR,
    interval: float = INTERVAL,
    meniscus: MeniscusModel = HURLE,
) -> Trace:
    """Run a policy once on one model of the paper."""
    config = make_config(scenario, model, control_interval=interval, horizon=horizon, meniscus=meniscus)
    run = rollout(policy, config, [0])
    lived = int(run.alive.sum())
    whole = Signals(
        *(np.concatenate([start[0], log[:lived, 0]]) for start, log in zip(run.start, run.signals, strict=True))
    )
    puller = make_puller(lam=MODELS[model], meniscus=meniscus)
    r_tilde = whole.r_br_measured - puller.ring_bias
    compensator = getattr(policy, "compensator", None)
    if compensator is not None:
        r_tilde = r_tilde + compensator.respond(whole.v_p - puller.v_0, interval)
    return Trace(interval * np.arange(lived + 1, dtype=np.float64), whole, r_tilde, bool(run.failed[0]))


class InverseResponse(NamedTuple):
    """The ring after a pull-speed change: first the wrong way, then across its old value."""

    depth: float
    """Largest excursion the wrong way [m]."""
    recovery: float
    """Time from the start of the change until the ring is back where it was [s]."""


def pull_change(
    model: str, change: float = -0.1, over: float = 600.0, before: float = 0.0, horizon: float = 1200.0
) -> Trace:
    """Change the pull speed by a share of v_0 along the quintic, at constant heater power; times in s."""
    middle = FINE * (np.arange(round(horizon / FINE)) + 0.5) - before
    share = change * quintic(np.clip(middle / over, 0.0, 1.0))
    return trace(PullSchedule(tuple(share.tolist())), model, horizon=horizon, interval=FINE)


def inverse_response(run: Trace, change: float = -0.1) -> InverseResponse:
    """Depth and recovery of a pull change that began at t = 0; ArithmeticError if the ring never comes back."""
    ring = run.signals.r_br - run.signals.r_br[0]
    # Pulling slower thickens the crystal; the ring's wrong way has the sign of the change.
    wrong = np.sign(change) * ring
    lowest = int(np.argmax(wrong))
    later = np.flatnonzero(wrong[lowest:] <= 0.0)
    if wrong[lowest] <= 0.0 or len(later) == 0:
        raise ArithmeticError("the ring shows no inverse response that recovers within the run")
    k = lowest + int(later[0])
    back = run.t[k - 1] + (run.t[k] - run.t[k - 1]) * wrong[k - 1] / (wrong[k - 1] - wrong[k])
    return InverseResponse(float(wrong[lowest]), float(back))


class StepComparison(NamedTuple):
    """A pull-speed step on the plant and on its linear model; deviations [m], shape (samples,)."""

    t: Floats
    share: float
    """Step as a share of v_0 [-]."""
    plant: tuple[Floats, Floats]
    """r_c and r_br."""
    linear: tuple[Floats, Floats]
    """The same, from the linear model."""

    def worst(self, output: int) -> float:
        """Largest difference over the largest deviation of the plant [-]."""
        gap = np.max(np.abs(self.plant[output] - self.linear[output]))
        return float(gap / np.max(np.abs(self.plant[output])))


def step_comparison(model: str, share: float, horizon: float = 600.0) -> StepComparison:
    """Step the pull speed of plant and linear model by a share of v_0."""
    steps = round(horizon / FINE)
    run = trace(PullSchedule((share,) * steps), model, horizon=horizon, interval=FINE)
    puller = make_puller(lam=MODELS[model])
    A, B, C, _ = linearise(puller)
    block = np.zeros((len(A) + 1, len(A) + 1))
    block[:-1, :-1], block[:-1, -1] = A * FINE, B[:, 0] * FINE * puller.v_0 * share
    move = expm(block)
    x, path = np.append(np.zeros(len(A)), 1.0), []
    for _ in run.t:
        path.append(C @ x[:-1])
        x = move @ x
    linear = np.array(path)
    s = run.signals
    seen = tuple(linear[:, OUTPUTS.index(name)] for name in ("r_c", "r_br"))
    return StepComparison(run.t, share, (s.r_c - s.r_c[0], s.r_br - s.r_br[0]), (seen[0], seen[1]))


class CaseDifference(NamedTuple):
    """max |A - 5 B| / max |A| of the deviations from the operating point [-]."""

    r_c: float
    h_c: float
    alpha_c: float
    v_p: float


def case_difference(a: Trace, b: Trace, scale: float = 5.0) -> CaseDifference:
    """How nonlinear the loop is between cases A and B."""
    gaps = []
    for name in CaseDifference._fields:
        large, small = (getattr(run.signals, name) for run in (a, b))
        deviation = large - large[0]
        gaps.append(np.max(np.abs(deviation - scale * (small - small[0]))) / np.max(np.abs(deviation)))
    return CaseDifference(*map(float, gaps))


def errors(run: Trace) -> tuple[Floats, Floats]:
    """r_c - r_ref and r_tilde - r_ref [m]."""
    return run.signals.r_c - run.signals.r_ref, run.r_tilde - run.signals.r_ref


def minutes(run: Trace) -> Floats:
    """Time [min]."""
    return run.t / MINUTE
