"""Invariants of every step of every slot: :class:`Watch`."""

from typing import Any

import numpy as np
import numpy.typing as npt

from cz_gym.body.signals import Cost, Logged
from cz_gym.physics.plant import HEIGHT_MAX_IN_A, HEIGHT_MIN, RADIUS_LIMIT, fourth_power
from cz_gym.physics.schedule import melt_left
from cz_gym.spaces import CLIP, HEATER_RANGE

Array = npt.NDArray[Any]
COLDEST, HOTTEST = 1000.0, 2600.0
"""Temperatures [K] that no hot zone with 10 kW more or less than nominal leaves."""
OVERSHOOT = HEIGHT_MIN
"""Largest distance beyond a limit at which a crystal fails [m]: no substep jumps farther."""
BALANCE = 2e-3
"""Heat that may be missing from a step's balance, as a share of the nominal heater power: the fluxes are taken as
straight lines over the step."""
_EPS = 1e-9


class Broken(AssertionError):
    """An invariant is violated; the message is one line."""


class Watch:
    """Checks everything an environment returns, and its heat balance; autoreset NEXT_STEP."""

    def __init__(self, env):
        self._env, self._slots = env, env._batch.memory.slots
        self._dt, self._steps = env.config.control_interval, env.config.steps
        self._over = np.zeros(env.num_envs, np.bool_)
        self._call = 0
        self.episodes = self.failures = 0
        self.missing_heat = 0.0

    def begin(self, observation, infos):
        """Check what the reset returned."""
        self._check_numbers(observation, np.zeros(self._env.num_envs), infos)

    def before(self):
        """Remember the slots; call it before each step."""
        self._old = self._slots.copy()

    def after(self, actions, observation, reward, terminated, truncated, infos):
        """Check what a step returned; raises :class:`Broken`."""
        self._call += 1
        ran, over = ~self._over, terminated | truncated
        self._check_numbers(observation, reward, infos)
        self._check_ends(ran, terminated, truncated, infos)
        self._check_rewards(ran, reward, terminated, infos)
        self._check_drives(ran, actions, infos)
        self._check_heat(ran & ~terminated, infos)
        self.episodes, self.failures = self.episodes + int(over.sum()), self.failures + int(terminated.sum())
        self._over = over

    def _need(self, fact, what):
        if not np.all(fact):
            raise Broken(f"step {self._call}, slot {int(np.argmin(fact))}: {what}")

    def _check_numbers(self, observation, reward, infos):
        finite = np.isfinite(observation).all(axis=1) & (np.abs(observation) <= CLIP).all(axis=1)
        self._need(finite, f"the observation is not finite and within +-{CLIP}")
        self._need(np.isfinite(reward), "the reward is not finite")
        for name in Logged._fields:
            self._need(np.isfinite(infos[name]), f"info {name!r} is not finite")
        if "state" in infos:
            self._need(np.isfinite(infos["state"]).all(axis=1), "info 'state' is not finite")

    def _check_ends(self, ran, terminated, truncated, infos):
        """Failures terminate, at the limits and nowhere else; time truncates; radii and heights are a crystal's."""
        k, a = self._slots["k"], self._slots["puller"]["a"]
        error, h_c = np.abs(infos["r_c"] - infos["r_ref"]), infos["h_c"]
        limits = ((error, 0.0, RADIUS_LIMIT), (h_c, HEIGHT_MIN, HEIGHT_MAX_IN_A * a))
        for value, low, high in limits:
            self._need(terminated | ((value >= low) & (value <= high)), "beyond a limit and not terminated")
            self._need((value > low - OVERSHOOT) & (value < high + OVERSHOOT), "far beyond a limit")
        self._need((infos["r_c"] > 0.0) & (h_c > 0.0), "a radius or height that is not positive")
        self._need(~ran | (truncated == ((k >= self._steps) & ~terminated)), "truncated before or after the horizon")
        self._need(~(~ran & (terminated | truncated)), "a new episode ends before its first step")
        self._need(ran | (k == 0), "an ended episode was not drawn anew")
        for name in ("T_1", "T_2", "T_b"):
            T = self._slots["x"][name]
            self._need((T > COLDEST) & (T < HOTTEST), f"{name} outside {COLDEST:g} to {HOTTEST:g} K")

    def _check_rewards(self, ran, reward, terminated, infos):
        """The reward is one minus the saturated cost of ``info``, and 1,000 less for a failing step."""
        cost = sum(infos[f"term_{name}"] for name in Cost._fields)
        expected = np.where(ran, 1.0 - 10.0 * cost / (10.0 + cost) - 1000.0 * terminated, 0.0)
        self._need(np.abs(reward - expected) < _EPS, "the reward does not follow from the cost")
        self._need(cost >= 0.0, "a negative cost")

    def _check_drives(self, ran, actions, infos):
        p, e, old = self._slots["puller"], self._slots["episode"], self._old
        pull, power = infos["v_p"] - p["v_0"], infos["Q_H"] - p["Q_H_0"]
        widest = np.minimum(p["v_0"], e["pull_window"]) * (1.0 + _EPS)
        self._need(np.abs(pull) <= widest, "the pull speed leaves its range")
        self._need(infos["Q_H"] >= 0.0, "the heater cools")
        self._need(np.abs(power) <= HEATER_RANGE * (1.0 + _EPS) + 0.5 * e["heater_step"], "the power leaves its range")
        moved = np.abs(infos["v_p"] - old["v_p"])
        self._need(~ran | (moved <= e["pull_slew"] * self._dt + _EPS * p["v_0"]), "the pull speed jumps")
        said = infos["action_clipped"] == (np.abs(actions) > 1.0).any(axis=1)
        self._need(~ran | said, "info 'action_clipped' is wrong")

    def _check_heat(self, living, infos):
        """Heat stored over the step is what flowed in less what flowed out."""
        p, old, new = self._slots["puller"], self._old["x"], self._slots["x"]
        middle = (self._slots["k"] - 0.5) * self._dt
        melt = melt_left(middle, self._slots["episode"].view(np.recarray))
        capacities = {"T_1": p["C_1"], "T_2": p["C_2"], "T_b": p["C_b"] * melt}
        stored = sum(capacity * (new[name] - old[name]) for name, capacity in capacities.items())
        flows = 0.5 * (_losses(p, old) + _losses(p, new))
        behind = self._slots["episode"]["heater_lag"] * (self._slots["Q_heats"] - self._old["Q_heats"])
        gained = self._dt * (infos["Q_H"] - flows + self._slots["Q_d"]) - behind
        gained -= _into_crystal(p, old, new, infos, self._dt)
        missing = np.where(living, np.abs(stored - gained) / (self._dt * p["Q_H_0"]), 0.0)
        self._need(missing <= BALANCE, "heat appears or disappears")
        self.missing_heat = max(self.missing_heat, float(missing.max()))


def _losses(p, x):
    """Heat that insulation and melt surface lose [W]."""
    surface, radiated = np.pi * (p["R_cr"] ** 2 - x["r_c"] ** 2), fourth_power(x["T_b"]) - fourth_power(p["T_e"])
    return p["G_1a"] * (x["T_1"] - p["T_a"]) + p["emission"] * surface * radiated


def _into_crystal(p, old, new, infos, dt):
    """Heat that the crystal takes from the melt in a step [J]: what it conducts away less its latent heat.

    A crystal grows by what was pulled less what the meniscus rose, so nothing needs the flux within the step, which
    fluctuates and grows without limit where a meniscus freezes.
    """
    grown = infos["v_p"] * dt - (new["h_c"] - old["h_c"])
    return np.pi * 0.5 * (old["r_c"] ** 2 + new["r_c"] ** 2) * (p["Phi_s"] * dt - p["rho_dH"] * grown)
