"""Millions of random and adversarial steps over the randomised pullers: ``python -m tests.stress``.

Every scenario, control intervals from 0.5 to 60 s, both models and every mix, every observation, the drives of
"puller", and pullers drawn far wider than any named scenario. After each step of each slot everything that leaves the
environment is checked, and the stored heat is balanced against the heat that flowed in and out. The first error stops
the command and names the case, the step and the slot.
"""

import argparse
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from cz_gym.body.signals import Cost, Logged
from cz_gym.config import make_config
from cz_gym.env import CzVectorEnv
from cz_gym.episodes.scenario import Interface
from cz_gym.episodes.scenarios import HARD, PULLER, SCENARIOS
from cz_gym.physics.plant import HEIGHT_MAX_IN_A, HEIGHT_MIN, RADIUS_LIMIT, fourth_power, melt_left
from cz_gym.spaces import CLIP, HEATER_RANGE
from cz_gym.support.units import MM
from tests.equations import hold

KINDS = (
    "uniform", "bang-bang", "full pull", "no pull", "kept alive, hot", "kept alive, cold", "infinite", "chatter",
    "random walk", "kept alive, bang-bang heat",
)  # fmt: skip
"""One kind a slot, in turn."""
EXTREME = np.array([np.inf, -np.inf, 1e308, -1e308, 1e-320, -0.0, 1.0 + 1e-7, -1.0 - 1e-7])


class Adversaries:
    """Actions for ``num_envs`` slots, slot i by kind i modulo the number of kinds."""

    def __init__(self, num_envs, seed):
        self._kind = np.arange(num_envs) % len(KINDS)
        self._random = np.random.default_rng([20, seed])
        self._bang = np.ones((num_envs, 2))
        self._walk = np.zeros((num_envs, 2))
        self._turn = 0

    def actions(self, infos, height):
        """The next actions, shape (num_envs, 2), from the last infos and the nominal heights [m], shape (num_envs,)."""
        random, n = self._random, len(self._kind)
        self._turn += 1
        self._bang *= np.where(random.random((n, 2)) < 0.02, -1.0, 1.0)
        self._walk = np.clip(self._walk + 0.1 * random.standard_normal((n, 2)), -1.5, 1.5)
        alive = hold(infos, height) + 0.02 * random.standard_normal(n)
        extreme = EXTREME[random.integers(len(EXTREME), size=(n, 2))]
        chatter = np.full((n, 2), 1.0 if self._turn % 2 else -1.0)
        one, none = np.ones(n), np.zeros(n)
        pairs = [(one, none), (-one, none), (alive, one), (alive, -one), (alive, self._bang[:, 1])]
        full, no, hot, cold, bang_heat = (np.stack(pair, axis=-1) for pair in pairs)
        uniform = random.uniform(-1.0, 1.0, (n, 2))
        by_kind = [uniform, self._bang, full, no, hot, cold, extreme, chatter, self._walk, bang_heat]
        return np.stack(by_kind)[self._kind, np.arange(n)]


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
        pull, power = infos["v_p"] - p["v_0"], infos["Q_H"] - (p["Q_H_0"] + e["told_power"])
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


INTERVALS = (0.5, 1.0, 2.0, 5.0, 7.5, 10.0, 20.0, 30.0, 60.0)
"""Control intervals [s]."""
MODELS = (None, "I", "II")
OBSERVATIONS = ("measured", "history", "state")
WIDE = replace(
    HARD,
    name="wide",
    pullers=replace(
        HARD.pullers, capillary=0.1, conductivity=0.3, conductance=0.3, start_radius_sd=2.0 * MM, melt_loss=0.5
    ),
    interface=Interface(sd=(0.0, 5.0)),
    sensor=PULLER.sensor,
    faults=SCENARIOS["sensor-fault"].faults,
    actuators=PULLER.actuators,
)
"""Pullers and disturbances far beyond the named scenarios."""
CALLS = 460
"""Steps in a row that a large campaign takes in each case; the rest goes into more slots."""


def cases():
    """Each scenario and "wide" at each interval; models and observations take turns, so that all meet."""
    return [
        make_config(scenario, MODELS[(at + turn) % 3], OBSERVATIONS[(at + 2 * turn) % 3], interval, action="direct")
        for at, scenario in enumerate((*SCENARIOS, WIDE))
        for turn, interval in enumerate(INTERVALS)
    ]


def run_case(config, steps, seed):
    """About ``steps`` slot steps of one case, at least one, all checked; raises :class:`Broken`."""
    n = len(KINDS) * max(1, round(steps / CALLS / len(KINDS)))
    # The horizon is cut so that every case meets ends by time as well.
    calls = max(1, round(steps / n))
    config = replace(config, horizon=min(config.horizon, max(1, 2 * calls // 3) * config.control_interval))
    env = CzVectorEnv.from_config(config, n, threads=1, info="all")
    adversaries, watch = Adversaries(n, seed), Watch(env)
    observation, infos = env.reset(seed=seed)
    watch.begin(observation, infos)
    for _ in range(calls):
        actions = adversaries.actions(infos, env._batch.memory.slots["puller"]["h_0"])
        watch.before()
        *result, infos = env.step(actions)
        watch.after(actions, *result, infos)
    env.close()
    return watch


def campaign(configs, steps, seed=0):
    """Share ``steps`` among the cases; raises :class:`Broken` with the name of the case in front."""
    watches = []
    for number, config in enumerate(configs):
        try:
            watches.append(run_case(config, -(-steps // len(configs)), seed + number))
        except Broken as broken:
            name = f"{config.scenario.name}, model {config.model}, {config.observation}, {config.control_interval:g} s"
            raise Broken(f"{name}, seed {seed + number}: {broken}") from None
    return watches


if __name__ == "__main__":
    parser = argparse.ArgumentParser("python -m tests.stress", description="Adversarial steps, checked at each.")
    parser.add_argument("--steps", type=int, default=1_000_000, help="slot steps in all (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="seed of actions and episodes (%(default)s)")
    arguments = parser.parse_args()
    watches = campaign(cases(), arguments.steps, arguments.seed)
    print(
        f"{len(watches)} cases, {sum(watch.episodes for watch in watches):,} episodes, "
        f"{sum(watch.failures for watch in watches):,} failures; "
        f"missing heat {max(watch.missing_heat for watch in watches):.1e} at most"
    )
