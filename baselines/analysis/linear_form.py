"""The state space of a shipped controller near rest, without what keeps its code from being linear there."""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from cz_gym.baselines.lqg.controller import LQG
from cz_gym.baselines.pid.filtered_pid import FilteredPID
from cz_gym.baselines.policy import OpenLoop
from cz_gym.config import Config
from cz_gym.episodes.scenario import Sensor
from cz_gym.episodes.scenarios import RANDOMIZED
from cz_gym.observation import HEATER_SCALE, MEASURED, PULL_SCALE, Measured, scales
from cz_gym.physics.linearisation import StateSpace
from cz_gym.support.nested import map_arrays

from .sampled_loop import NotLinearError, linear_controller

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
    readings = map_arrays(np.zeros_like, state.readings)
    memory, moving = state.memory, ("memory.filter.mean", "memory.command")
    settled = memory.filter._replace(mean=0.0 * memory.filter.mean)
    still = memory._replace(filter=settled, plan=0.0 * memory.plan, command=0.0 * memory.command)
    rest = state._replace(readings=readings, memory=still)
    controller = linear_controller(linear, (policy.v_0, policy.heater_range), rest, moving)
    return LinearForm(controller, controller, policy.control_interval)
