"""A controller's state space, without what keeps its code from being linear at rest."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from cz_gym.baselines.lqg.controller import LQG
from cz_gym.baselines.pid.filtered_pid import FilteredPID
from cz_gym.baselines.pid.open_loop import OpenLoop
from cz_gym.config import Config
from cz_gym.observation import MEASURED, PULL_SCALE, Measured
from cz_gym.physics.linearisation import StateSpace
from cz_gym.units import MM

from .sampled_loop import NotLinearError, linear_controller

SETTLING = 720
"""Samples after which a filter's covariance has settled."""
CAMERA_NOISE, PYROMETER_NOISE = 0.025 * MM, 0.05
"""Standard deviations a Kalman filter settles on [m, K]: the middle of the randomised scenario's ranges."""


class LinearForm(NamedTuple):
    """A controller near rest."""

    controller: StateSpace
    free: StateSpace
    """The same without anti-windup, for a loop opened at the pull speed."""
    dt: float
    """Control interval [s]."""


def linear_form(policy: Any) -> LinearForm:
    """The linear form of a controller that acts every ``control_interval``, 5 s if it does not say; NotLinearError if
    it has none.

    An LQG that predicts through the plant's equations is taken with its linear prediction, at the covariance it
    settles on under mean noise, references held.
    """
    if isinstance(policy, OpenLoop):
        raise NotLinearError("there is no loop")
    if isinstance(policy, LQG):
        return _lqg(policy)
    v_0 = getattr(policy, "v_0", PULL_SCALE)
    controller = linear_controller(policy, v_0)
    if not (controller.C.any() or controller.D.any()):
        raise NotLinearError("there is no loop: nothing that is measured moves a drive")
    free = linear_controller(replace(policy, T_track=np.inf), v_0) if isinstance(policy, FilteredPID) else controller
    return LinearForm(controller, free, getattr(policy, "control_interval", Config().control_interval))


def _lqg(policy: LQG) -> LinearForm:
    linear = replace(policy, settings=replace(policy.settings, nonlinear=False))
    random, state = np.random.default_rng(0), None
    scale = {channel.name: channel.scale for channel in MEASURED}
    for _ in range(SETTLING):
        noise = random.standard_normal(2)
        observation = np.zeros(len(MEASURED))
        observation[Measured._fields.index("valid")] = 1.0
        observation[Measured._fields.index("ring_error")] = CAMERA_NOISE / scale["ring_error"] * noise[0]
        observation[Measured._fields.index("T_1")] = PYROMETER_NOISE / scale["T_1"] * noise[1]
        _, state = linear.predict(observation, state)
    assert state is not None
    mean = 0.0 * state.filter.mean
    rest = state._replace(filter=state.filter._replace(mean=mean), plan=0.0 * state.plan, command=0.0 * state.command)
    found = linear_controller(linear, policy.v_0, rest, ("filter.mean", "command"))
    return LinearForm(found, found, policy.control_interval)
