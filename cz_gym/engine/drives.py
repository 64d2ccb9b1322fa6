"""The drives of a slot: pull speed and heater power, moved by actions within their ranges and rates."""

from typing import Any

import numpy as np

from cz_gym.jit.compile import jittable

from .arithmetic import clip


@jittable
def next_speed(v_p: Any, pull: Any, drives: Any, nominal: Any, e: Any, interval: Any) -> Any:
    """The pull speed [m/s] after an action, within its window and slew rate."""
    speed = drives.keep * ((v_p - nominal) / drives.speed) + drives.pull * clip(pull, 1.0)
    wanted = nominal + clip(drives.speed * clip(speed, 1.0), e.pull_window)
    return v_p + clip(wanted - v_p, e.pull_slew * interval)


@jittable
def next_power(Q_H: Any, heat: Any, drives: Any, nominal: Any, e: Any, interval: Any) -> Any:
    """The heater power [W] after an action, within its slew rate, before it is rounded to whole steps."""
    share = drives.keep * ((Q_H - nominal) / drives.power) + drives.heater * clip(heat, 1.0)
    power = nominal + drives.power * clip(share, 1.0)
    power = power if power.real > 0.0 else 0.0
    return Q_H + clip(power - Q_H, e.heater_slew * interval)


@jittable
def drive(slot: Any, pull: Any, heat: Any, drives: Any, interval: Any, process: Any) -> None:
    """Move the drives by an action, the heater in whole steps."""
    e, nominal = slot.episode, process.nominal(slot.x, slot)
    slot.v_p_before, slot.Q_H_before = slot.v_p, slot.Q_H
    slot.clipped = 1.0 if (np.abs(pull) > 1.0 or np.abs(heat) > 1.0) else 0.0
    slot.v_p = next_speed(slot.v_p, pull, drives, nominal.v_p, e, interval)
    slot.Q_H_slewed = next_power(slot.Q_H_slewed, heat, drives, nominal.Q_H, e, interval)
    slot.Q_H = slot.Q_H_slewed
    if e.heater_step > 0.0:
        whole = nominal.Q_H + e.heater_step * np.rint((slot.Q_H_slewed - nominal.Q_H) / e.heater_step)
        slot.Q_H = np.maximum(whole, 0.0)
    process.carry(slot, interval)
