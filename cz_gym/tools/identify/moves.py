"""Excitation of a log: the moves of a drive that answer no reading.

A controller's moves are a function of its readings, which a drive's slew rate and range cut off. A linear law is fitted
to the moves; where a limit cut a move, the law need only ask for as much or more. What the drive has done besides in a
window counts, by the larger of two measures. Run freely over the window, on the readings alone, the law does not know
that a slow drive has begun to ramp. Asked for one move at a time, it does not know a step before the readings show it:
where the pyrometer shows the power in seconds, the law that runs freely follows the power through its effect.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.signal import lfilter, max_len_seq

from cz_gym.physics.parameters import Parameters
from cz_gym.physics.plant import make_puller
from cz_gym.puller.file import DEFAULT, PullerFile
from cz_gym.spaces import DRIVE_CHANNELS, HEATER_RANGE, decode, drives_of, tag
from cz_gym.support.errors import CzError
from cz_gym.support.units import MINUTE, MM

from .log import Floats, Log

MOVE, ENOUGH = 0.005, (20 * 0.015**2, 20 * 0.005**2)
"""Unexplained moves count from this share of nominal on; their squares must add up to those of 20 steps of 1.5 % of the
pull speed, whose path is hidden by the ring's noise, and of 0.5 % of the power."""
WINDOW = MINUTE
"""Time over which moves are summed [s]."""
SHARE = 0.2
"""Share of a drive's usual move in a window that must be unexplained; less is what the law is not exact for [-]."""
FEW = 0.1
"""Share of the windows that do not count: those with the largest moves, which a reading may explain that is lost."""
STEP, LASTS, LARGER, SEVERAL = 0.015, 0.7, 3.0, 3
"""Steps of a step test, which count although they are among the largest moves: least size, as a share of nominal; share
of it that must be left in the windows beside, since a controller takes a kick back; least ratio to the other windows'
moves; least number of such steps."""
PAST, MEANS = 6, (20.0, 60.0, 200.0, 600.0)
"""Last values of drive and readings that explain a move, and time constants of means that do, too [s]."""
ROUNDS, EDGE = 30, 0.05
"""Rounds of the fit, and the share of a limit from which on a move is taken for cut off."""


class Law(NamedTuple):
    """Linear law from a controller's past readings and moves to its next move."""

    weights: Floats
    """Weights of the readings, then of the drive's last values and means, then a constant."""
    keep: Floats
    """Shares of the drive's means that are left after a row [-]."""
    slew: float
    lowest: float
    highest: float

    def move_limits(self, before: Floats) -> tuple[Floats, Floats]:
        """Least and largest move from where the drive was."""
        return np.maximum(-self.slew, self.lowest - before), np.minimum(self.slew, self.highest - before)

    @property
    def own(self) -> Floats:
        """Weights of the drive's last values and means."""
        return self.weights[-1 - PAST - len(MEANS) : -1]

    def run(self, asked: Floats, past: Floats, means: Floats) -> Floats:
        """Run the law freely over windows; ``asked``: moves that the readings ask for, shape (windows, rows).

        Returns the drive at the end of each window.
        """
        for each in asked.T:
            now = past[:, 0] + np.clip(each + np.hstack([past, means]) @ self.own, *self.move_limits(past[:, 0]))
            past, means = np.column_stack([now, past[:, :-1]]), self.keep * means + (1.0 - self.keep) * now[:, None]
        last: Floats = past[:, 0]
        return last


def measure_excitation(logs: Sequence[Log], start: PullerFile = DEFAULT) -> tuple[float, float]:
    """Sum the moves of pull speed and heater that no reading explains, in multiples of what is needed [-].

    The pull speed counts only where the heater does too: a controller with gates and nested limits moves it in ways
    that no linear law explains, up to 25 times what is needed, but not the slow heater.
    """
    pull = heater = 0.0
    for log in logs:
        errors = np.stack([log.ring - np.nan_to_num(log.r_ref), log.T_1 - np.nan_to_num(log.T_1_ref)], axis=1)
        pull += float(np.square(_unexplained(log.v_p / start.parameters.v_0, errors, log)).sum()) / ENOUGH[0]
        heater += float(np.square(_unexplained(log.Q_H / np.median(log.Q_H), errors, log)).sum()) / ENOUGH[1]
    return (pull if heater >= 1.0 else 0.0), heater


def _unexplained(drive: Floats, readings: Floats, log: Log) -> Floats:
    """Moves in windows that no reading explains, in shares of nominal; none if the law explains nearly all."""
    at = np.flatnonzero(np.diff(drive)) + 1
    pace = int(np.median(np.diff(at))) if len(at) > 1 else 1
    step, readings, drive = pace * log.interval, readings[::pace], drive[::pace] - drive[::pace].mean()
    rows, per = np.arange(PAST, len(drive)), max(2, round(WINDOW / step))
    if len(rows) < 10 * (PAST + len(MEANS)):
        return np.zeros(0)
    known = np.where(np.isnan(readings), np.nanmedian(readings, axis=0), readings)
    keep = np.exp(-step / np.array(MEANS))
    seen, own = _past(known - known.mean(axis=0), keep, rows), _past(drive[:, None], keep, rows)
    lost = np.isnan(readings).any(axis=1) | np.isin(np.arange(len(drive)), np.flatnonzero(log.gap) // pace)
    whole = lfilter(np.ones(max(PAST, per)), [1.0], lost)[rows - 1] < 0.5
    whole |= whole.mean() < 0.5
    law = _fit(np.hstack([seen, own]), moves := np.diff(drive)[rows - 1], drive, whole, keep)
    windows = np.arange(len(rows) // per * per).reshape(-1, per)
    count, sound = len(windows), windows[whole[windows].all(axis=1)]
    windows = sound if len(sound) else windows
    first, last = windows[:, 0], rows[windows[:, -1]]
    asked = seen @ law.weights[: seen.shape[1]] + law.weights[-1]
    free = drive[last] - law.run(asked[windows], own[first, :PAST], own[first, PAST:])
    single = (moves - np.clip(asked + own @ law.own, *law.move_limits(own[:, 0])))[windows].sum(axis=1)
    usual = drive[last] - drive[rows[first] - 1]
    usual = np.sort(np.abs(usual))[: int((1.0 - FEW) * len(usual))]
    left, steps = max(map(_counted, (free, single)), key=lambda each: float(np.linalg.norm(np.concatenate(each))))
    more = np.sqrt(count / len(windows))  # those left out moved as much
    known = np.linalg.norm(left) <= SHARE * np.linalg.norm(usual)
    moved: Floats = more * np.concatenate([left[(left > MOVE) & ~known], steps])
    return moved


def _counted(moves: Floats) -> tuple[Floats, Floats]:
    """Sizes of the moves of all windows but FEW with the largest ones, and of those the steps that last."""
    sizes, around = np.abs(moves), np.abs(np.convolve(moves, np.ones(3), "same"))
    order, few = np.argsort(sizes), int((1.0 - FEW) * len(moves))
    rest, largest = sizes[order[:few]], order[few:]
    least = max(STEP, LARGER * rest.max(initial=0.0))
    steps = sizes[largest][(sizes[largest] >= least) & (around[largest] >= LASTS * sizes[largest])]
    return rest, steps if len(steps) >= SEVERAL else steps[:0]


def _past(values: Floats, keep: Floats, rows: npt.NDArray[np.int64]) -> Floats:
    """Last values and exponential means before each row, shape (rows, (PAST + MEANS) signals)."""
    means = [lfilter([1.0 - k], [1.0, -k], values, axis=0, zi=k * values[:1])[0][rows - 1] for k in keep]
    return np.concatenate([*(values[rows - 1 - lag] for lag in range(PAST)), *means], axis=1)


def _fit(X: Floats, moves: Floats, drive: Floats, whole: npt.NDArray[np.bool_], keep: Floats) -> Law:
    """Fit the law that asks for the moves: a censored regression by successive imputation."""
    sizes, most, ends = np.maximum(X.std(axis=0), 1e-12), np.abs(moves).max(), (drive.min(), drive.max())
    slew = most if np.mean(np.abs(moves) > (1.0 - EDGE) * most) > 0.01 else np.inf
    low, high = (
        end if np.mean(drive == end) > 0.005 else sign * np.inf for end, sign in zip(ends, (-1.0, 1.0), strict=True)
    )
    law = Law(np.zeros(0), keep, float(slew), float(low), float(high))
    least, largest = law.move_limits(drive[PAST - 1 : -1])
    over = (np.abs(largest) > EDGE * most) & (moves >= largest - EDGE * most)
    under = (np.abs(least) > EDGE * most) & (moves <= least + EDGE * most)
    scaled = np.column_stack([X / sizes, np.ones(len(X))])
    inverse, asked, weights = np.linalg.pinv(scaled[whole], rcond=1e-10), moves, np.zeros(0)
    for _ in range(ROUNDS if (over | under).any() else 1):
        weights = inverse @ asked[whole]
        wanted = scaled @ weights
        asked = np.where(over, np.maximum(wanted, moves), np.where(under, np.minimum(wanted, moves), moves))
    return law._replace(weights=weights / np.append(sizes, 1.0))


# Excitation: a pseudo-random binary sequence on both drives, added to any controller.
#
# A log of a controller alone cannot tell what the pull speed does, because every move answers a reading. Small moves
# that answer nothing make it identifiable.

BITS = 7
CHIPS = 2**BITS - 1
"""Length of the sequence [chips]; the heater's is the same, half of it later."""
SEQUENCE = 2.0 * max_len_seq(BITS)[0] - 1.0


class ExcitationMemory(NamedTuple):
    """Memory of an excited policy."""

    inner: Any
    """Memory of the policy inside."""
    step: npt.NDArray[np.int64]
    """Number of samples, shape (n,)."""
    added: npt.NDArray[np.float64]
    """Deviation of the drives by the excitation, in shares of their ranges, shape (n, 2)."""
    stopped: npt.NDArray[np.bool_]
    """True where the radius error has ended the excitation, shape (n,)."""


@dataclass(frozen=True)
class Excited:
    """Policy whose drives also follow a maximal-length binary sequence.

    The sequence ends for good where the ring is further than ``limit`` from its reference. The policy inside does not
    see the moves that are added, else one that moves from the applied drives would keep them. The drives' limits are
    those of the environment or plant. Observations are "measured" or "history" (whose past shows the excitation).
    """

    policy: Any
    pull: float = 0.025
    """Amplitude in shares of v_0 [-]; 0 for none."""
    heater: float = 0.025
    """Amplitude in shares of the nominal power [-]; 0 for none."""
    clock: float = 60.0
    """Length of a chip [s]."""
    limit: float = 1.5 * MM
    """Largest radius error, as the ring shows it [m]."""

    def __post_init__(self) -> None:
        if not (0.0 <= self.pull <= 0.1 and 0.0 <= self.heater <= 0.1):
            raise CzError(f"amplitudes of the excitation lie in 0 to 0.1, not {self.pull!r} and {self.heater!r}")
        if getattr(self.made_for, "puller", "default") != "default" and not hasattr(self.policy, "heater_range"):
            name = type(self.policy).__name__
            raise CzError(f"{name} does not say its puller's numbers: excite a controller that does")
        if not self.clock >= self.interval:
            raise CzError(f"the clock {self.clock!r} s must be at least the control interval of {self.interval:g} s")

    @property
    def interval(self) -> float:
        """Control interval [s]."""
        return float(getattr(self.policy, "control_interval", 5.0))

    @property
    def heater_range(self) -> float:
        """Change of the heater's power by an action of 1 [W]."""
        return float(getattr(self.policy, "heater_range", HEATER_RANGE))

    @property
    def made_for(self) -> Any:
        """Environment that the policy was made for, None if it does not say."""
        return getattr(self.policy, "made_for", None)

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Any, ExcitationMemory]:
        """Return the action and the next memory; arguments as of :class:`cz_gym.baselines.policy.Policy`."""
        shown = np.array(observation, np.float64)
        seen, single = np.atleast_2d(shown), shown.ndim == 1
        n, parameters = len(seen), getattr(self.policy, "parameters", Parameters())
        begins = np.zeros(n, np.bool_) if episode_start is None else np.asarray(episode_start, np.bool_)
        if state is None:
            begins = np.ones(n, np.bool_)
        last = state or ExcitationMemory(None, np.zeros(n, np.int64), np.zeros((n, 2)), begins)
        step, before = np.where(begins, 0, last.step), np.where(begins[:, None], 0.0, last.added)
        error = decode(seen, parameters.v_0, self.heater_range).ring_error
        stopped = (last.stopped & ~begins) | (np.abs(error) > self.limit)
        chip = (step * self.interval / self.clock + 1e-9).astype(np.int64)
        size = self.pull, self.heater * make_puller(parameters).Q_H_0 / self.heater_range
        signs = np.stack([SEQUENCE[chip % CHIPS], SEQUENCE[(chip + CHIPS // 2) % CHIPS]], axis=1)
        wanted = np.where(stopped[:, None], 0.0, size * signs)
        seen[:, list(DRIVE_CHANNELS)] -= before
        action, inner = self.policy.predict(shown.astype(np.float32), last.inner, episode_start, deterministic)
        drives = drives_of(str(getattr(self.made_for or self.policy, "action", "direct")), self.interval)
        given = np.atleast_2d(np.asarray(action, np.float64))
        out = np.clip(given + drives.asked(wanted, before), -1.0, 1.0)
        added = drives.keep * before + (out - given) * (drives.pull, drives.heater)
        tagged = tag((out[0] if single else out).astype(np.float32), self.made_for)
        return tagged, ExcitationMemory(inner, step + 1, added, stopped)
