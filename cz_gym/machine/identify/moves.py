"""Excitation of a log: the moves of a drive that answer no reading.

A controller's moves are a function of its readings, which a drive's slew rate and range cut off. A linear law is fitted
to the moves; where a limit cut a move, the law need only ask for as much or more. The law then runs freely over a
window, on the readings alone, and what the drive has done besides counts: a slow drive that has ramped for a minute has
moved by a minute's ramp, whatever a row of its log shows.
"""

import numpy as np
import numpy.typing as npt
from scipy.signal import lfilter

from cz_gym.machine.puller import DEFAULT, PullerFile
from cz_gym.support.units import MINUTE

from .grid import Floats, Log

MOVE, ENOUGH = 0.005, 20 * 0.01**2
"""Unexplained moves count from this share of nominal on; their squares must add up to those of 20 steps of 1 %."""
WINDOW = MINUTE
"""Time over which moves are summed [s]."""
SHARE = 0.2
"""Share of a drive's usual move in a window that must be unexplained; less is what the law is not exact for [-]."""
PAST, MEANS = 6, (20.0, 60.0, 200.0, 600.0)
"""Last values of drive and readings that explain a move, and time constants of means that do, too [s]."""
ROUNDS, EDGE = 30, 0.05
"""Rounds of the fit, and the share of a limit from which on a move is taken for cut off."""


def measure_excitation(log: Log, start: PullerFile = DEFAULT) -> tuple[float, float]:
    """:func:`excitation` of pull speed and heater."""
    errors = np.stack([log.ring - np.nan_to_num(log.r_ref), log.T_1 - np.nan_to_num(log.T_1_ref)], axis=1)
    drives = log.v_p / start.parameters.v_0, log.Q_H / np.median(log.Q_H)
    return tuple(excitation(drive, errors, log.interval, log.gap) for drive in drives)


def excitation(drive: Floats, readings: Floats, interval: float, gap: npt.NDArray[np.bool_]) -> float:
    """How much a drive, in shares of nominal, moves on its own; 1 is just enough."""
    at = np.flatnonzero(np.diff(drive)) + 1
    pace = int(np.median(np.diff(at))) if len(at) > 1 else 1
    known = np.where(np.isnan(readings), np.nanmedian(readings, axis=0), readings)
    gaps, drive, known = np.flatnonzero(gap) // pace, drive[::pace], known[::pace]
    rows, step = np.arange(PAST, len(drive)), pace * interval
    seen = [known[rows - 1 - lag] for lag in range(PAST)] + [_mean(known, tau / step)[rows - 1] for tau in MEANS]
    own = [drive[rows - 1 - lag, None] for lag in range(PAST)] + [
        _mean(drive[:, None], tau / step)[rows - 1] for tau in MEANS
    ]
    X = np.concatenate([*seen, *own], axis=1)
    centre, size = X.mean(axis=0), np.maximum(X.std(axis=0), 1e-12)
    X = np.column_stack([(X - centre) / size, np.ones(len(X))])
    if len(rows) < 4 * X.shape[1]:
        return 0.0
    moves, ranges = drive[rows] - drive[rows - 1], _limits(drive)
    law = _law(X, moves, *_room(drive[rows - 1], *ranges))
    per = max(2, round(WINDOW / step))
    begins = np.arange(0, len(rows) - per, per)
    left = drive[rows][begins + per - 1] - _run(X, law, centre, size, drive, rows, begins, per, step, ranges)
    usual = drive[rows][begins + per - 1] - drive[rows - 1][begins]
    left = left[~np.isin(begins // per, gaps // per)]
    if np.sqrt(np.mean(left**2)) < SHARE * np.sqrt(np.mean(usual**2)):
        return 0.0
    return float(np.square(left[np.abs(left) > MOVE]).sum() / ENOUGH)


def _run(X, law, centre, size, drive, rows, begins, per, step, ranges):
    """Where the law leads in a window from where the drive was at its beginning."""
    own = len(centre) - PAST - len(MEANS)
    fixed = X[:, :own] @ law[:own] + law[-1]
    past = drive[rows[begins][:, None] - 1 - np.arange(PAST)]
    means = np.stack([_mean(drive[:, None], tau / step)[rows[begins] - 1, 0] for tau in MEANS], axis=1)
    keep = np.exp(-step / np.array(MEANS))
    for k in range(per):
        features = (np.concatenate([past, means], axis=1) - centre[own:]) / size[own:]
        low, high = _room(past[:, 0], *ranges)
        now = past[:, 0] + np.clip(fixed[begins + k] + features @ law[own:-1], low, high)
        past, means = np.column_stack([now, past[:, :-1]]), keep * means + (1.0 - keep) * now[:, None]
    return past[:, 0]


def _mean(values: Floats, rows: float) -> Floats:
    """Exponential mean."""
    keep = np.exp(-1.0 / rows)
    mean: Floats = lfilter([1.0 - keep], [1.0, -keep], values, axis=0, zi=keep * values[:1])[0]
    return mean


def _limits(drive: Floats) -> tuple[float, float, float]:
    """Largest move, least and largest value of a drive, as far as the log shows that they limit it."""
    moves, ends = np.abs(np.diff(drive)), (drive.min(), drive.max())
    slew = moves.max() if np.mean(moves > (1.0 - EDGE) * moves.max()) > 0.01 else np.inf
    low, high = (
        end if np.mean(drive == end) > 0.005 else sign * np.inf for end, sign in zip(ends, (-1.0, 1.0), strict=True)
    )
    return slew, low, high


def _room(before: Floats, slew: float, lowest: float, highest: float) -> tuple[Floats, Floats]:
    """The least and largest move from where a drive is."""
    return np.maximum(-slew, lowest - before), np.minimum(slew, highest - before)


def _law(X: Floats, moves: Floats, low: Floats, high: Floats) -> Floats:
    """Weights of the linear law that asks for the moves; a censored regression by successive imputation."""
    edge = EDGE * np.abs(moves).max()
    over, under = (np.abs(high) > edge) & (moves >= high - edge), (np.abs(low) > edge) & (moves <= low + edge)
    inverse, asked = np.linalg.pinv(X, rcond=1e-10), moves
    for _ in range(ROUNDS if (over | under).any() else 1):
        law: Floats = inverse @ asked
        wanted = X @ law
        asked = np.where(over, np.maximum(wanted, moves), np.where(under, np.minimum(wanted, moves), moves))
    return law
