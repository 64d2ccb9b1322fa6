"""PIDs of a whole crystal on the bright ring: with gains that change in the cones, and a compensator that runs along.

The ring moves with the meniscus height as well as with the radius, in the crown ten times as much as in the body. The
compensator predicts the height's deviation from the recipe from the applied pull speed and takes its share off the
ring, with both numbers scheduled on the length. Radii [m], speeds [m/s], temperatures [K], power [W].
"""

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np

from cz_gym.baselines.pid.compensated_pid import PIDState, SeriesPID
from cz_gym.baselines.pid.temperature_loop import Heat, TemperatureLoop
from cz_gym.baselines.policy import Floats, MeasuredController, check_numbers
from cz_gym.crystal.linearisation import Along, along
from cz_gym.crystal.process import CRYSTAL
from cz_gym.crystal.signals import Measured, TrueState
from cz_gym.process import Process, scales, signals
from cz_gym.support.units import MM

BLEND = 40.0 * MM
"""Length of body over which the gain changes after the crown and before the tail [m]."""


def in_cones(factor: float, L: Floats, q: Any) -> Floats:
    """A factor at a length: 1 in the body, ``factor`` in the cones; it changes within :data:`BLEND` of the body, as a
    jump would kick the pull.
    """
    ends = q.crown_length + q.body_length
    at = q.crown_length, q.crown_length + BLEND, ends - BLEND, ends
    return np.interp(L, at, (factor, 1.0, 1.0, factor))


class Memory(NamedTuple):
    """The memory of :class:`CrystalPID`; each of shape (n,)."""

    height: Floats
    """Predicted deviation of the meniscus height from the recipe's [m]."""
    filtered: Floats
    """Filtered radius error [m]."""
    pid: PIDState
    command: Floats
    """Last commanded pull speed above the recipe's [m/s]."""
    heat: Heat
    start: Floats
    """What the pyrometer showed above the recipe at the first sample [K]."""


@dataclass(frozen=True)
class CrystalPID(MeasuredController):
    """v_p = recipe + K F (gain e), e the ring's error, less c_h(L) dh if it compensates.

    dh' = v_p - recipe - (a_h(L) + slow) dh, F = 1/(1 + T_f s); gain is 1 in the body, ``cone_gain`` in crown and tail.
    The integrator follows the applied pull speed within ``T_track``. The recipe's temperature is shifted to what the
    pyrometer shows at the start, as an operator does: the crystal grows there.
    """

    process: ClassVar[Process] = CRYSTAL

    pid: SeriesPID = field(default_factory=SeriesPID)
    cone_gain: float = 1.0
    """Gain of the error in crown and tail [-]."""
    compensates: bool = True
    """Whether the predicted height is taken off the ring."""
    lam: float = 0.5
    """Share of conduction in its model [-]."""
    slow: float = 2.0e-4
    """Rate with which the predicted height is forgotten [rad/s]."""
    T_f: float = 20.0
    """Time constant of the measurement filter [s]; 0 for none."""
    T_track: float = 600.0
    """Time constant with which the integrator follows a limited drive [s]."""
    heater: TemperatureLoop = field(default_factory=TemperatureLoop)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_numbers(self, positive=("T_track",), not_negative=("cone_gain", "slow", "T_f"))

    @cached_property
    def schedule(self) -> Along:
        """The linearisation along the recipe."""
        return along(self.parameters, self.meniscus, self.lam)

    def at_rest(self, seen: Any) -> Memory:
        """The applied pull speed and power continue."""
        zero = np.zeros_like(seen.v_p)
        pid = PIDState(zero, zero, seen.v_p / self.pid.K_p)
        return Memory(zero, zero, pid, seen.v_p, self.heater.at_rest(seen), seen.T_1 - seen.T_1_ref)

    def step(self, seen: Any, memory: Memory) -> tuple[Floats, Floats, Memory]:
        """Pull speed and heater power above the recipe's, and the new memory."""
        dt, at = self.control_interval, self.schedule
        forgets = np.interp(seen.L, at.L, at.a_h) + self.slow
        left = np.exp(-forgets * dt)
        height = left * memory.height + (1.0 - left) / forgets * seen.v_p
        error = seen.ring_error - (np.interp(seen.L, at.L, at.c_h) * height if self.compensates else 0.0)
        pace = -math.expm1(-dt / self.T_f) if self.T_f > 0.0 else 1.0
        filtered = memory.filtered + pace * (error - memory.filtered)
        missed = (seen.v_p - memory.command) / self.pid.K_p
        tracking = memory.pid.integral + min(dt / self.T_track, 1.0) * missed
        gain = in_cones(self.cone_gain, seen.L, self.parameters)
        pull, pid = self.pid.step(gain * filtered, memory.pid._replace(integral=tracking), dt)
        shifted = seen._replace(T_1_ref=seen.T_1_ref + memory.start)
        power, heat = self.heater.step(shifted, memory.heat, dt, self.v_0, self.heater_range)
        return pull, power, Memory(height, filtered, pid, pull, heat, memory.start)


@dataclass(frozen=True)
class TrueRadiusPID(CrystalPID):
    """The same on the true radius, which no sensor shows: a bound."""

    observation: ClassVar[str] = "state"

    compensates: bool = False

    def read(self, array: Floats) -> Any:
        """The true state in the measured channels."""
        channels = tuple(signals(TrueState).values())
        true = TrueState(*np.moveaxis(array * scales(channels, self.v_0, self.heater_range), -1, 0))
        known = {name: getattr(true, name) for name in Measured._fields if name in TrueState._fields}
        nothing = np.zeros_like(true.L)
        return Measured(**dict.fromkeys(Measured._fields, nothing) | known)._replace(
            ring_error=true.r_c_error, valid=nothing + 1.0
        )
