"""Linear analysis of loops: sampled ones from the code that runs, Part II's compensator design, margins.

The state space of a controller comes from its own ``predict``, called with one unit of each memory entry and of each
observation channel; its memory must be a NamedTuple of arrays. So the margins are those of the shipped code. Timing is
that of the environment: measure at t_k, act at once; the v_p and Q_H observed at t_k were applied before.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import bisect
from scipy.signal import cont2discrete

from cz_gym.body.process import OUTPUTS, STATES, RadiusModel, linearise
from cz_gym.body.signals import Measured
from cz_gym.config import Config
from cz_gym.episodes.scenario import Sensor
from cz_gym.episodes.scenarios import RANDOMIZED
from cz_gym.physics.parameters import Parameters
from cz_gym.physics.plant import Puller, make_puller
from cz_gym.process import HEATER_SCALE, PULL_SCALE, Floats, StateSpace, scales
from cz_gym.spaces import DRIVE_CHANNELS, HEATER_RANGE, MEASURED
from cz_gym.support.errors import CzError, leaves, map_arrays

from .lqg import LQG
from .pid import Compensator, FilteredPID, SeriesPID
from .policy import ControllerState, DriveLimits, MeasuredController, OpenLoop

_SMALL = 1e-6
"""Observed amplitude below every limit, gate and dead zone [-]; float32 actions keep their relative precision."""
_SEEN = ("ring_error", "T_1", "v_p", "Q_H")
"""Channels through which the plant reaches the controller."""
SEEN = [Measured._fields.index(name) for name in _SEEN]
"""Places in an observation of the channels through which the plant reaches the controller."""
_AT_REST = np.array([float(channel.name == "valid") for channel in MEASURED])
"""Observation at rest: zeros and a valid camera."""
_DISTURBED = ("v_p", "Q_H", "camera")
"""Inputs of a loop."""
HOT_ZONE = {name: name for name in ("C_1", "C_2", "C_b", "kappa_12", "G_1a", "G_2b")} | {"kappa_b": "eps"}
"""Constants of a puller that follow from estimates, and the parameter that each is proportional to."""
_NOMINAL = Parameters()
WIDEST = 4.0
"""Largest factor on a parameter for which a loop's stability is asked; the smallest is its inverse [-]."""
_ANSWERS = ("v_p", "Q_H", "r_br")
"""Outputs of a loop: both commands and the ring."""


class NotLinearError(CzError):
    """A controller that has no state space near rest."""


class Loop(NamedTuple):
    """Plant and controller together, z(k+1) = A z + B w, y = C z + D w, with w of _DISTURBED and y of _ANSWERS."""

    A: Floats
    B: Floats
    C: Floats
    D: Floats
    dt: float
    """Control interval [s]."""

    @property
    def stable(self) -> bool:
        """Stability: every pole lies inside the unit circle."""
        return float(np.abs(np.linalg.eigvals(self.A)).max()) < 1.0

    def pick(self, output: str, inputs: tuple[str, ...]) -> StateSpace:
        """The system from some inputs to one output."""
        row, columns = _ANSWERS.index(output), [_DISTURBED.index(name) for name in inputs]
        return StateSpace(self.A, self.B[:, columns], self.C[[row]], self.D[np.ix_([row], columns)])


def linear_controller(
    policy: Any,
    ranges: tuple[float, float] = (PULL_SCALE, HEATER_RANGE),
    rest: Any = None,
    free: Sequence[str] | None = None,
) -> StateSpace:
    """The controller in discrete time: inputs the channels of Measured, outputs v_p - v_0 [m/s] and Q_H - Q_H0 [W].

    ``ranges`` [m/s, W] is what an action of 1 moves the drives by. ``rest`` is its memory at rest, by default that
    after one sample of zeros. ``free`` names the parts of it that move ("memory.filter.mean"), by default all of the
    controller's own; the others, such as a covariance, keep their value. The inputs v_p and Q_H are the applied drives,
    which a :class:`~.policy.MeasuredController` takes from its last setpoints; limits of drives are left out.
    Raises NotLinearError if the controller does not rest there, or if twice the input does not double the answer.
    """
    channels, name = len(MEASURED), type(policy).__name__
    policy = replace(policy, limits=DriveLimits()) if isinstance(policy, MeasuredController) else policy
    rest = policy.predict(_AT_REST[None])[1] if rest is None else rest
    rest = () if rest is None else rest
    if not isinstance(rest, tuple):
        raise NotLinearError(f"{name} has a memory that is no named tuple of arrays, so it has no state space here")
    parts = _parts(rest)
    if free is None:
        shell = ("readings.", "asked", "difference") if isinstance(rest, ControllerState) else ()
        free = [part for part in parts if not part.startswith(shell)] if shell else [*parts]
    memory = sum(parts[part].size for part in free)
    probes = np.eye(memory + channels) * _SMALL
    sizes = scales(MEASURED, *ranges)
    still, once, twice = (_answer(policy, factor * probes, rest, free, sizes) for factor in (0.0, 1.0, 2.0))
    once, twice = once - still, twice - still
    largest = np.abs(once).max(axis=0)
    if np.any(np.abs(still) > 1e-3 * _SMALL):
        raise NotLinearError(f"{name} does not rest at zero")
    if np.any(np.abs(twice - 2.0 * once) > 1e-4 * largest):
        raise NotLinearError(f"{name} is not linear near rest")
    gains = once.T / _SMALL
    gains[:, memory:] /= sizes
    gains[memory:] *= np.array(ranges)[:, None]
    (A, B), (C, D) = (np.split(rows, [memory], axis=1) for rows in np.split(gains, [memory]))
    return StateSpace(A, B, C, D)


def _parts(memory: Any) -> dict[str, Floats]:
    """The arrays of a memory's first slot, by their names in the nested tuple."""
    return {name: np.asarray(part, np.float64)[:1] for name, part in leaves(memory, ".").items()}


def _answer(policy: Any, probes: Floats, rest: Any, free: Sequence[str], sizes: Floats) -> Floats:
    """The next free memory and the action for rows of (free memory, observation), both relative to rest."""
    n, start, parts = len(probes), 0, {}
    for name, value in _parts(rest).items():
        parts[name] = np.repeat(value, n, axis=0)
        if name in free:
            parts[name] += probes[:, start : start + value.size].reshape(n, *value.shape[1:])
            start += value.size
    if isinstance(rest, ControllerState):
        parts["asked"] += (probes[:, start:] * sizes)[:, DRIVE_CHANNELS]
    values = iter(parts.values())
    action, after = policy.predict(_AT_REST + probes[:, start:], state=map_arrays(lambda _: next(values), rest))
    moved = map_arrays(lambda new, old: np.reshape(new - old[:1], (1, n, -1)), rest if after is None else after, rest)
    return np.hstack([*(part[0] for name, part in _parts(moved).items() if name in free), action])


class Lags(NamedTuple):
    """Lags of a loop beyond the plant's own equations [s]; delays between whole samples are interpolated."""

    latency: float = 0.0
    """Latency of the camera."""
    heater_lag: float = 0.0
    """Time constant of the heater's power."""
    heater_dead_time: float = 0.0
    pyrometer_filter: float = 0.0
    """Time constant of the pyrometer."""


NO_LAGS = Lags()


def sampled_plant(puller: Puller, dt: float, lags: Lags = NO_LAGS) -> StateSpace:
    """The plant with held inputs v_p, Q_H and outputs r_br, T_1; deviations in SI units."""
    A, B, C, _ = linearise(puller)
    B, C = B[:, :2], np.stack([C[OUTPUTS.index("r_br")], np.eye(len(STATES))[STATES.index("T_1")]])
    if (tau := lags.heater_lag) > 0.0:
        A = np.block([[A, B[:, 1:]], [np.zeros((1, len(A))), -np.eye(1) / tau]])
        B, C = np.vstack([B * [1.0, 0.0], [0.0, 1.0 / tau]]), np.hstack([C, np.zeros((2, 1))])
    if (tau := lags.pyrometer_filter) > 0.0:
        A = np.block([[A, np.zeros((len(A), 1))], [C[1:] / tau, -np.eye(1) / tau]])
        B, C = np.vstack([B, np.zeros((1, 2))]), np.hstack([C * [[1.0], [0.0]], [[0.0], [1.0]]])
    A, B, *_ = cont2discrete((A, B, C, np.zeros((2, 2))), dt, method="zoh")
    for delay, at_drive in ((lags.heater_dead_time, True), (lags.latency, False)):
        if delay > 0.0:
            A, B, C = _delayed(A, B, C, delay / dt, at_drive)
    return StateSpace(A, B, C, np.zeros((2, 2)))


def _delayed(A: Floats, B: Floats, C: Floats, samples: float, at_drive: bool) -> tuple[Floats, Floats, Floats]:
    """A sampled plant whose heater, or whose ring, is late by a number of samples."""
    whole = math.floor(samples + 1e-9)
    part, n, length = max(samples - whole, 0.0), len(A), whole + (samples - whole > 1e-9)
    shift, weights = np.eye(length, k=-1), np.zeros((1, length + 1))
    weights[0, whole] = 1.0 - part
    weights[0, length] += part
    enters = np.eye(length, 1)
    if at_drive:
        heat = B[:, 1:]
        A = np.block([[A, heat @ weights[:, 1:]], [np.zeros((length, n)), shift]])
        B = np.vstack([np.hstack([B[:, :1], heat * weights[0, 0]]), np.hstack([0.0 * enters, enters])])
        return A, B, np.hstack([C, np.zeros((2, length))])
    A = np.block([[A, np.zeros((n, length))], [enters @ C[:1], shift]])
    late = np.hstack([weights[0, 0] * C[:1], weights[:, 1:]])
    return A, np.vstack([B, np.zeros((length, 2))]), np.vstack([late, np.hstack([C[1:], np.zeros((1, length))])])


def close(controller: StateSpace, puller: Puller, dt: float, broken: str = "", lags: Lags = NO_LAGS) -> Loop:
    """The loop of controller and plant.

    Inputs: v_p (added to the command), Q_H (heat that the controller does not see), camera noise; references held.
    Outputs: v_p and Q_H (the commands), r_br. ``broken="camera"`` opens the loop at the camera: the controller reads
    only the input ``camera``. ``broken="v_p"`` opens it at the pull speed: plant and controller see only the input
    ``v_p``. ``broken="Q_H"`` opens it between heater and hot zone: the plant gets only the input ``Q_H``, and the
    controller sees its command applied. The state is (plant, last applied v_p and Q_H, controller).
    """
    plant, inputs = sampled_plant(puller, dt, lags), len(_DISTURBED)
    n = len(plant.A)
    seen = np.zeros((len(_SEEN), n + 2))
    seen[0, :n], seen[1, :n] = plant.C[0] * (broken != "camera"), plant.C[1]
    seen[2, n], seen[3, n + 1] = 1.0, 1.0
    noise = np.zeros((len(_SEEN), inputs))
    noise[0, _DISTURBED.index("camera")] = 1.0
    B, D = controller.B[:, SEEN], controller.D[:, SEEN]
    command, direct = np.hstack([D @ seen, controller.C]), D @ noise
    pulls, heats = float(broken != "v_p"), float(broken != "Q_H")
    apply = np.vstack([plant.B @ np.diag([pulls, heats]), np.diag([pulls, 1.0])])
    own, disturbed = np.zeros((n + 2, n + 2)), np.zeros((n + 2, inputs))
    own[:n, :n], disturbed[:n, :2], disturbed[n, 0] = plant.A, plant.B, 1.0
    moved = np.hstack([own, np.zeros((n + 2, len(controller.A)))]) + apply @ command
    ring = np.hstack([plant.C[:1], np.zeros((1, command.shape[1] - n))])
    own, disturbed = np.vstack([moved, np.hstack([B @ seen, controller.A])]), disturbed + apply @ direct
    direct = np.vstack([direct, np.zeros((1, inputs))])
    return Loop(own, np.vstack([disturbed, B @ noise]), np.vstack([command, ring]), direct, dt)


def stable_range(
    controller: StateSpace, dt: float, parameter: str, lam: float, nominal: Parameters = _NOMINAL
) -> tuple[float, float]:
    """Range of a factor on that parameter, at most 1/WIDEST to WIDEST, in which the loop is stable; NaN if not at 1."""

    def stable(factor: float) -> bool:
        puller = make_puller(nominal._replace(**{parameter: factor * getattr(nominal, parameter)}), lam)
        return close(controller, puller, dt).stable

    def end(farthest: float) -> float:
        for inside, outside in pairwise(np.geomspace(1.0, farthest, 16)):
            if not stable(outside):
                edge = bisect(lambda factor: float(stable(factor)) - 0.5, inside, outside, rtol=1e-3)
                return float(edge)
        return farthest

    return (end(1.0 / WIDEST), end(WIDEST)) if stable(1.0) else (math.nan, math.nan)


# Part II's design of the compensator, and the margins of its continuous loop

CUT_OFF = Compensator().slow
"""The paper's high-pass cut-off [rad/s]."""
_ROUNDING = 1e-9
"""Smallest pole that is stable, in units of the largest [-]."""


class Margins(NamedTuple):
    """Margins of an open loop and the poles of the closed one."""

    crossover: float
    """Frequency where the loop's gain is one [rad/s]."""
    phase_margin_deg: float
    """Phase above -180 degrees at the crossover [degrees]."""
    poles: npt.NDArray[np.complex128]
    """Closed-loop poles, slowest first [rad/s]."""

    @property
    def stable(self) -> bool:
        """Stability: every closed-loop pole lies in the left half plane."""
        return bool(np.all(self.poles.real < 0.0))


def design_compensator(model: RadiusModel, cut_off: float = CUT_OFF) -> Compensator:
    """Part II's design from a linear model of the plant and the high-pass cut-off [rad/s].

    The ideal compensator G_p (1 - G_m) turns the ring into the radius. It is high-pass filtered by s / (s + cut_off),
    its partial fractions with stable poles are kept, and their steady-state gain is removed. CzError unless
    the stable part has two poles: Model II has none of its own, so only that of the filter would remain.
    """
    if not cut_off > 0.0:
        raise CzError(f"cut_off must be a positive frequency [rad/s], not {cut_off!r}")
    poles = np.array([*model.poles, -cut_off])
    stable = np.unique(poles[poles < -_ROUNDING * np.abs(poles).max()])
    if len(stable) != 2:
        shown = ", ".join(f"{pole:.4g}" for pole in poles)
        raise CzError(f"a compensator needs two stable poles; those of plant and filter are {shown} rad/s")
    numerator = model.numerator * np.array([-model.lead, 1.0 - model.constant, 0.0])
    residues = [np.polyval(numerator, pole) / np.prod(pole - poles[poles != pole]) for pole in stable]
    fast, slow = -stable
    return Compensator(float(sum(residues)), float(fast), float(slow))


def controller_transfer(pid: SeriesPID) -> Any:
    """K(s) as a python-control transfer function."""
    import control

    numerator = pid.K_p * np.polymul([pid.T_i, 1.0], [pid.T_d, 1.0])
    return control.tf(numerator, np.polymul([pid.T_i, 0.0], [pid.T_d / pid.N, 1.0]))


def open_loop(model: RadiusModel, compensator: Compensator | None, pid: SeriesPID) -> Any:
    """L = -K (G_m G_p + G_pc) as a python-control transfer function; minus, since pulling faster thins the crystal."""
    import control

    seen = control.tf([model.numerator * model.lead, model.numerator * model.constant], np.poly(model.poles))
    if compensator is not None:
        seen += control.tf([compensator.gain, 0.0], np.poly([-compensator.fast, -compensator.slow]))
    return -controller_transfer(pid) * seen


def margins(model: RadiusModel, compensator: Compensator | None, pid: SeriesPID) -> Margins:
    """Crossover, phase margin and closed-loop poles of the continuous loop; NaN where the gain never crosses one."""
    import control

    loop = open_loop(model, compensator, pid)
    _, phase, _, crossover = control.margin(loop)
    poles = control.feedback(loop, 1).poles()
    return Margins(float(crossover), float(phase), poles[np.argsort(np.abs(poles))])


# Margins of sampled loops

SLOWEST = 1e-4
"""Lowest frequency [rad/s]: a period of 17 hours, slower than the drift of any episode."""


class LoopMargins(NamedTuple):
    """Margins of a stable loop at the place where it was opened; NaN where one does not exist."""

    crossover: float
    """Highest frequency where the loop's gain falls through one [rad/s]."""
    gain_up: float
    """Factor by which the gain may grow [-]."""
    gain_down: float
    """Factor by which the gain may fall [-]."""
    phase_deg: float
    """Least phase margin over all crossings [degrees]."""
    delay: float
    """Least delay that destabilises [s]."""
    sensitivity: float
    """Peak of |1/(1 + L)| [-]: 1 over the distance to the critical point."""


def frequencies(dt: float, points: int = 2000) -> Floats:
    """Logarithmic grid [rad/s] from SLOWEST up to the Nyquist frequency."""
    return np.geomspace(SLOWEST, np.pi / dt, points)


def response(system: StateSpace, dt: float, omega: Floats) -> npt.NDArray[np.complex128]:
    """Frequency response of a discrete single-input single-output system, by python-control."""
    import control

    values: npt.NDArray[np.complex128] = control.ss(*system, dt)(np.exp(1j * omega * dt))
    return values


def opened(controller: StateSpace, puller: Puller, dt: float, at: str) -> StateSpace:
    """The open loop L, opened at "camera" (only the plant is uncertain), at "v_p" (as in the paper, where the
    controller's use of its own pull speed counts as plant), or at "Q_H" (only the hot zone is uncertain)."""
    A, B, C, D = close(controller, puller, dt, broken=at).pick("r_br" if at == "camera" else at, (at,))
    return StateSpace(A, B, -C, -D)


def loop_margins(
    controller: StateSpace,
    puller: Puller,
    dt: float,
    at: str = "camera",
    stable: bool | None = None,
    points: int = 2000,
) -> LoopMargins:
    """Margins of a loop opened at a place, on a grid; all but the crossover are NaN if it is not ``stable``."""
    import control

    omega = frequencies(dt, points)
    values = response(opened(controller, puller, dt, at), dt, omega)
    log_gain = np.log(np.abs(values))
    falls = np.flatnonzero((log_gain[:-1] > 0.0) & (log_gain[1:] <= 0.0))[-1:]
    share = log_gain[falls] / (log_gain[falls] - log_gain[falls + 1])
    crossover = _pick(omega[falls] * (omega[falls + 1] / omega[falls]) ** share, np.max)
    if not (close(controller, puller, dt).stable if stable is None else stable):
        return LoopMargins(crossover, *[float("nan")] * 5)
    gain, phase, _, _, crossing, _ = control.stability_margins(control.frd(values, omega), returnall=True)
    # A delay also turns a real loop gain above one at the Nyquist frequency to the critical point's side.
    nyquist = np.mod(np.angle(values[-1:]) + np.pi, 2.0 * np.pi) * dt / np.pi
    late = np.append(np.radians(np.mod(phase, 360.0)) / crossing, nyquist[np.abs(values[-1:]) > 1.0])
    gains = _pick(gain[gain > 1.0], np.min), _pick(gain[gain < 1.0], np.max)
    sensitivity = float(np.max(1.0 / np.abs(1.0 + values)))
    return LoopMargins(crossover, *gains, _pick(np.abs(phase), np.min), _pick(late, np.min), sensitivity)


def _pick(values: Any, which: Any) -> float:
    return float(which(values)) if len(values) else float("nan")


# Shipped controllers near rest, without the parts of their code that are not linear there

SETTLING = 720
"""Number of samples after which a filter's covariance has settled."""


class LinearForm(NamedTuple):
    """A controller near rest."""

    controller: StateSpace
    free: StateSpace
    """The controller without anti-windup, for a loop opened at the pull speed."""
    dt: float
    """Control interval [s]."""


def linear_form(policy: Any, sensor: Sensor = RANDOMIZED.sensor) -> LinearForm:
    """The linear form of a controller with an attribute ``control_interval`` (default 5 s); NotLinearError for none.

    An LQG that predicts with the plant's equations is taken with its linear prediction, and with the covariance on
    which it settles under the mean noise of that ``sensor``, references held; an adaptive LQG with a single filter.
    """
    if isinstance(policy, OpenLoop):
        raise NotLinearError("there is no loop")
    if isinstance(policy, LQG):
        return _lqg(policy, sensor)
    ranges = getattr(policy, "v_0", PULL_SCALE), getattr(policy, "heater_range", HEATER_SCALE)
    controller = linear_controller(policy, ranges)
    if not (controller.C.any() or controller.D.any()):
        raise NotLinearError("there is no loop: nothing that is measured moves a drive")
    free = linear_controller(replace(policy, T_track=np.inf), ranges) if isinstance(policy, FilteredPID) else controller
    return LinearForm(controller, free, getattr(policy, "control_interval", Config().control_interval))


def _lqg(policy: LQG, sensor: Sensor) -> LinearForm:
    linear = replace(policy, design=replace(policy.design, nonlinear=False), hypotheses=None)
    random, state = np.random.default_rng(0), None
    scale = dict(zip(Measured._fields, scales(MEASURED, policy.v_0, policy.heater_range), strict=True))
    noises = {"ring_error": np.mean(sensor.camera_noise), "T_1": np.mean(sensor.pyrometer_noise)}
    for _ in range(SETTLING):
        observation = np.zeros(len(MEASURED))
        observation[Measured._fields.index("valid")] = 1.0
        for name, sd in noises.items():
            observation[Measured._fields.index(name)] = sd / scale[name] * random.standard_normal()
        _, state = linear.predict(observation, state)
    assert state is not None
    rest = map_arrays(np.zeros_like, state._replace(memory=()))
    memory, moving = state.memory, ("memory.filter.mean", "memory.command")
    settled = memory.filter._replace(mean=0.0 * memory.filter.mean)
    still = memory._replace(filter=settled, plan=0.0 * memory.plan, command=0.0 * memory.command)
    rest = rest._replace(memory=still)
    controller = linear_controller(linear, (policy.v_0, policy.heater_range), rest, moving)
    return LinearForm(controller, controller, policy.control_interval)
