"""The arrays of the compiled loops: the memory of a slot, the constants of a step and its results."""

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from cz_gym.episodes.draw import FREEZES, Episode, Stream
from cz_gym.episodes.rng import WORDS
from cz_gym.jit import static
from cz_gym.physics.meniscus import MeniscusModel
from cz_gym.process import Inputs, Process, Readings
from cz_gym.support.errors import CzError


def _record(kind: Any) -> np.dtype[Any]:
    return np.dtype([(name, np.float64) for name in kind._fields])


@cache
def slot_type(process: Process) -> np.dtype[Any]:
    """One slot of a process.

    Constants of puller and episode, plant state, drives [m/s, W], the disturbance of the last substep, last readings
    (``ring`` [m] without the operator's bias, with the meniscus height ``h_seen`` [m] and the sample ``k_seen`` it was
    taken at, ``T_1`` [K], ``valid``), the integral of the scaled ring error, the drift [K] that ``Q_d`` belongs to, the
    sample number ``k``, the number of camera frames taken, whether the episode is over, the ``key`` it was drawn from
    and the index of its ``scenario`` in the mixture, the drives [m/s, W] of the step before and whether the action was
    clipped: a sample can be written again from its slot. Then the 5 s grid point that ``dT_i`` belongs to with its two
    processes [standard deviations], the episode's random streams, as far as they are drawn from, the power that heats
    [W] where the heater is slow, the pyrometer's filter with the true temperature at the last sample [K], the nominal
    drives [m/s, W] from which the last action was counted, what resolution and delay change in the readings of the
    drives [m/s, W], and what the process adds: the fields of ``StepMemory`` and
    its table.
    """
    number, whole, table = np.float64, np.int64, process.table
    return np.dtype(
        [
            ("puller", _record(process.Constants)),
            ("episode", _record(Episode)),
            ("x", _record(process.State)),
            ("freezes", number, (FREEZES, 2)),
            *((name, number) for name in ("v_p", "Q_H", "Q_H_slewed", "dT_i", "Q_d", "ring", "h_seen", "T_1", "valid")),
            *((name, number) for name in ("integral", "drift")),
            *((name, whole) for name in ("k", "frames", "over", "k_seen")),
            ("key", np.uint64, (2,)),
            ("scenario", whole),
            *((name, number) for name in ("v_p_before", "Q_H_before", "clipped")),
            ("point", whole),
            ("fast", number),
            ("slow", number),
            ("streams", np.uint64, (len(Stream), WORDS)),
            *((name, number) for name in ("Q_heats", "T_filtered", "T_1_before")),
            *((name, number) for name in ("v_p_nominal", "Q_H_nominal", "v_p_misread", "Q_H_misread")),
            *((name, number) for name in process.StepMemory._fields),
            *([("table", number, table)] if table[0] else []),
        ],
        align=True,
    )


@static
class Model(NamedTuple):
    """A process on a meniscus, compiled into the loops, and the places of its numbers (:func:`model_of`)."""

    process: Process
    meniscus: MeniscusModel
    stride: int
    """Length of a slot [numbers of 8 bytes]."""
    slot_numbers: int
    """Length of a slot without its table [numbers of 8 bytes]."""
    info_rows: int
    """Rows of ``info``."""
    brief_rows: tuple[int, ...]
    """Rows of ``info="lean"``, and that of the clipped action."""
    constants: int
    """Number of the puller's constants: place of the episode in a slot, row of the state in a lane."""
    states: int
    """Number of states: place of the pull speed in the differentiable state."""
    u_at: int
    """Row of the inputs in a lane."""
    power_at: int
    """Row of the power that heats in a lane."""
    d_at: int
    """Row of the disturbance in a lane."""
    dt_at: int
    """Row of the substep [s] in a lane; then the time that is reached [s], and whether the slot goes on."""
    lane_rows: int
    memory_at: int
    """Place of ``StepMemory`` in the differentiable state; number of states and inputs."""
    memories: int
    """Number of fields of ``StepMemory``."""
    nominal: int
    """Place of the nominal inputs in the differentiable state."""
    nominals: int
    """Number of the nominal inputs there: none where they do not move."""
    ring: int
    """Place of the ring in the differentiable state; the reading follows."""
    smooth: int
    """Length of the differentiable state: column of the first action, row of the cost's first term."""
    columns: int
    """Columns of a Jacobian: differentiable state and actions."""
    costs: int
    """Number of terms of the cost."""
    driven_by: int
    """Columns of the next inputs' derivatives: state, inputs, actions, the nominal inputs before."""
    memory_by: int
    """Columns of the derivatives of ``StepMemory``: itself, the inputs, the nominal ones."""
    cost_by: int
    """Columns of the cost's derivatives: state, inputs and those before, ``StepMemory``."""
    channels: int
    """Number of channels of "measured"."""
    shown_by: int
    """Columns of their derivatives: state, inputs, the nominal ones, ``StepMemory``, readings."""


@cache
def model_of(process: Process, meniscus: MeniscusModel) -> Model:
    """The model of a process on a meniscus."""
    u, stride = len(Inputs._fields), slot_type(process).itemsize // 8
    constants, states, loads, memories, costs = (
        len(kind._fields)
        for kind in (process.Constants, process.State, process.Disturbance, process.StepMemory, process.Cost)
    )
    u_at, nominal, nominals = constants + states, states + u + memories, u if process.nominal_moves else 0
    ring = nominal + nominals
    dt_at, lean = u_at + u + loads, (*process.BriefInfo._fields, "action_clipped")
    return Model(
        process, meniscus, stride, stride - process.table[0] * process.table[1], len(process.info),
        tuple(map(process.info.index, lean)), constants, states, u_at, u_at + 1, u_at + u, dt_at, dt_at + 3,
        states + u, memories, nominal, nominals, ring, ring + 2, ring + 2 + u, costs, states + 3 * u, memories + 2 * u,
        states + 2 * u + memories, len(process.measured), states + 2 * u + memories + len(Readings._fields),
    )  # fmt: skip


class BatchConstants(NamedTuple):
    """Constants that all slots share and no step changes: time base, radius limit, cost weights, logged series."""

    interval: float
    """Control interval [s]."""
    steps: int
    """Steps in an episode."""
    grid_points: int
    """Points of the 5 s grid in an episode."""
    radius_limit: float
    """Largest |r_c - r_ref| [m]."""
    weights: Any
    """Weights of the cost's terms, a named tuple."""
    series: Any
    """Load [W] and fluctuation [K] from logs, one row a scenario, shape (scenarios, points, 2); no points: none."""


class SlotMemory(NamedTuple):
    """The memory of the slots, one row per slot."""

    slots: Any
    """Records of :func:`slot_type`, shape (n,)."""
    numbers: Any
    """The same memory as plain float64, shape (n, numbers a record)."""
    history: Any
    """Running sums of the remembered channels, circular in time, shape (n, depth, channels); depth 0: none."""
    frames: Any
    """Time [s], ring [m] and meniscus height [m] of camera frames, the power [W] set in each control interval, and
    pull speed [m/s] and power [W] at each sample: all circular in time, shape (n, depth, 6)."""


class Out(NamedTuple):
    """The results of a step, one row per slot."""

    observation: Any
    """The "measured" or "history" channels, float32, shape (n, channels)."""
    state: Any
    """The "state" channels, float32, shape (n, channels); of width 0 if not wanted."""
    image: Any
    """The camera's image, uint8, shape (n, rows, columns, 1); empty unless it is the observation. Written after the
    step, by :mod:`cz_gym.camera.image`."""
    reward: Any
    """Float64, shape (n,)."""
    terminated: Any
    """Bool, shape (n,)."""
    truncated: Any
    """Bool, shape (n,)."""
    info: Any
    """Rows of the process' ``Logged``, float64, shape (rows, n or a little more:
    see :func:`info_width`)."""


class ObservationScales(NamedTuple):
    """Constants with which a slot's signals become an observation."""

    measured: Any
    """One over the scales of the measured channels, shape (channels,)."""
    state: Any
    """One over the scales of the state channels, shape (channels,)."""
    newest: Any
    """Age of the newest sample of each remembered span, shape (lags,)."""
    before: Any
    """Age of the sample before the oldest one of each span, shape (lags,)."""
    share: Any
    """One over the number of samples in each span, shape (lags,)."""
    everything: bool
    """True: all of ``info`` is written; false: the rows of ``BriefInfo`` and ``action_clipped``."""


INFO_CHOICES = ("lean", "all")


def check_info(info: str) -> bool:
    """Return whether all of ``info`` is wanted; raise CzError for anything but "lean" and "all"."""
    if info not in INFO_CHOICES:
        raise CzError(f"info must be one of {', '.join(INFO_CHOICES)}, not {info!r}")
    return info == "all"


def info_width(n: int) -> int:
    """Length of an info row for n slots: rows a multiple of 4 KiB apart would share one set of the cache."""
    return n + 8 if n % 64 == 0 else n
