"""The drives of a slot: pull speed and heater power, moved by actions within their ranges and rates."""

from typing import Any

import numpy as np

from cz_gym.jit.compile import force_inlined, jittable, labelled, set_labelled
from cz_gym.physics.arithmetic import clip
from cz_gym.process import Inputs

_EPS, _POWER = 1e-9, 3


@jittable
def next_speed(v_p: Any, pull: Any, drives: Any, nominal: Any, before: Any, e: Any, interval: Any) -> Any:
    """The pull speed [m/s] after an action, within its window and slew rate; ``before``: nominal for the last one."""
    speed = drives.keep * ((v_p - before) / drives.speed) + drives.pull * clip(pull, 1.0)
    wanted = nominal + clip(drives.speed * clip(speed, 1.0), e.pull_window)
    return v_p + clip(wanted - v_p, e.pull_slew * interval)


@jittable
def next_power(Q_H: Any, heat: Any, drives: Any, nominal: Any, before: Any, e: Any, interval: Any) -> Any:
    """The heater power [W] after an action, within its slew rate, before it is rounded to whole steps."""
    share = drives.keep * ((Q_H - before) / drives.power) + drives.heater * clip(heat, 1.0)
    power = nominal + drives.power * clip(share, 1.0)
    power = power if power.real > 0.0 else 0.0
    return Q_H + clip(power - Q_H, e.heater_slew * interval)


@jittable
def next_inputs(x: Any, u: Any, action: Any, before: Any, drives: Any, slot: Any, interval: Any, process: Any) -> Any:
    """The inputs after an action, before the heater is rounded to whole steps, from those before and the state;
    ``before`` are the inputs from which the last action was counted."""
    e, nominal = slot.episode, process.nominal(x, slot, interval)
    return Inputs(
        next_speed(u.v_p, action.v_p, drives, nominal.v_p, before.v_p, e, interval),
        next_power(u.Q_H, action.Q_H, drives, nominal.Q_H, before.Q_H, e, interval),
    )


@jittable
def drive(slot: Any, pull: Any, heat: Any, drives: Any, interval: Any, process: Any) -> None:
    """Move the drives by an action, the heater in whole steps, and with them what the process carries on."""
    e, x = slot.episode, labelled(process.State, slot.x)
    slot.v_p_before, slot.Q_H_before = slot.v_p, slot.Q_H
    slot.clipped = 1.0 if (np.abs(pull) > 1.0 or np.abs(heat) > 1.0) else 0.0
    nominal, before = process.nominal(x, slot, interval), Inputs(slot.v_p_nominal, slot.Q_H_nominal)
    u = next_inputs(x, Inputs(slot.v_p, slot.Q_H_slewed), Inputs(pull, heat), before, drives, slot, interval, process)
    slot.v_p, slot.Q_H_slewed, slot.Q_H = u.v_p, u.Q_H, u.Q_H
    slot.v_p_nominal, slot.Q_H_nominal = nominal.v_p, nominal.Q_H
    if e.heater_step > 0.0:
        whole = nominal.Q_H + e.heater_step * np.rint((slot.Q_H_slewed - nominal.Q_H) / e.heater_step)
        slot.Q_H = np.maximum(whole, 0.0)
    extra = process.carry(labelled(process.Extra, slot), labelled(Inputs, slot), nominal, interval)
    set_labelled(process.Extra, extra, slot)


@force_inlined
def is_slow(e: Any) -> Any:
    """Whether the power that heats is not simply the one that was set."""
    return e.heater_lag + e.heater_dead_time > 0.0


@jittable
def mean_power(slot: Any, frames: Any, start: Any, stop: Any, interval: Any) -> Any:
    """Mean power [W] that heats from ``start`` to ``stop`` [s]: the one set, after the dead time and through the lag.

    The power set is constant in each control interval, so that both are exact, and the mean gives the plant the energy.
    ``frames`` holds those of the last intervals, this one's is added; the lag's output stays in the slot.
    """
    depth, lag, dead_time = frames.shape[0], slot.episode.heater_lag, slot.episode.heater_dead_time
    frames[slot.k % depth, _POWER] = slot.Q_H
    t, energy = start, 0.0
    while t < stop - _EPS:
        step = int(np.floor((t - dead_time) / interval + _EPS))
        end = min((step + 1) * interval + dead_time, stop)
        power, done = frames[step % depth, _POWER], -np.expm1(-(end - t) / lag) if lag > 0.0 else 1.0
        behind = slot.Q_heats - power
        energy += power * (end - t) + behind * lag * done
        slot.Q_heats = power + behind * (1.0 - done)
        t = end
    return energy / (stop - start)
