"""Metrics against values worked out by hand, and those of whole crystals against the recipe's balance."""

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cz_gym.baselines.pid import CompensatedPID
from cz_gym.baselines.policy import OpenLoop
from cz_gym.body.signals import Cost, Logged, reward
from cz_gym.config import make_config
from cz_gym.crystal import recipe
from cz_gym.crystal.process import CRYSTAL, nominal_recipe
from cz_gym.crystal.recipe import FAILURE_MODES, relative_margin
from cz_gym.episodes.scenario import Actuators, Scenario
from cz_gym.evaluation.metrics import Metrics, crystal_metrics, metrics
from cz_gym.evaluation.protocol import TEST_SEEDS
from cz_gym.evaluation.rollout import Rollout, rollout
from cz_gym.physics.meniscus import HURLE
from cz_gym.support.units import MM
from tests.observed import PLAIN

DT = 5.0
R, V, Q = 0.0875, 2e-5, 60e3
MM_PER_MIN = 1e-3 / 60


def made_up(steps, lived=None, scenario="nominal", **signals):
    """One episode of a perfect crystal but for the given signals; with ``lived``, it fails at that step."""
    config = make_config(scenario, control_interval=DT, horizon=DT * steps, **PLAIN)
    calm = dict.fromkeys(Logged._fields, 0.0) | {"r_c": R, "r_ref": R, "v_p": V, "v_g": V, "Q_H": Q}
    columns = {name: np.full((steps, 1), value) for name, value in calm.items()}
    for name, value in signals.items():
        columns[name] = np.broadcast_to(np.asarray(value, float), steps).reshape(steps, 1).copy()
    alive = np.arange(steps)[:, None] < (steps if lived is None else lived)
    start = Logged(**{name: np.full((1, 1), value) for name, value in calm.items()})
    failed = np.array([lived is not None])
    return Rollout(config, (0,), Logged(**columns), np.zeros((steps, 1)), alive, failed, start, 0.0)


def of(run):
    """The metrics of the one episode."""
    return Metrics(*(value.item() for value in metrics(run)))


ERROR = np.where(np.arange(100) < 25, 0.6e-3, 0.2e-3) * np.where(np.arange(100) % 2, 1, -1)
MOVING = R - np.linspace(0, 2.5e-3, 100)
FASTER = V * np.where(np.arange(1440) < 720, 1.0, 1.0601)
TAPER = np.linspace(0.0880, 0.0860, 20_001)
TERMS = {f"term_{name}": np.linspace(0.0, size, 10) for size, name in enumerate(Cost._fields, 1)}
LIVED = sum(each[:3].sum() for each in TERMS.values())
KNOWN = {
    "a perfect crystal": (720, {}, dict(zip(Metrics._fields, (0, 0, 0, 0, 1, 0, 0, 1, *[0] * 7), strict=True))),
    "error against a reference that moves": (
        100,
        {"r_c": MOVING + ERROR, "r_ref": MOVING},
        {"rmse_mm": np.sqrt(0.25 * 0.36 + 0.75 * 0.04), "max_error_mm": 0.6, "within_half_mm": 0.75},
    ),
    # The ring reads 0.3 mm too wide: a crystal held 0.3 mm too thin is all that a controller can do.
    "fooled by the ring": (
        100, {"r_c": R - 0.3e-3, "ring_offset": 0.3e-3}, {"rmse_mm": 0.3, "rmse_observable_mm": 0.0}),
    "lucky": (100, {"ring_offset": 0.3e-3}, {"rmse_mm": 0, "rmse_observable_mm": 0.3}),
    "drives of the time lived, the first step a step": (
        100,
        {"lived": 50, "v_p": V + 0.1 * MM_PER_MIN, "v_g": V - 0.2 * MM_PER_MIN},
        {"pull_rms_mm_per_min": 0.1, "growth_rate_rms_mm_per_min": 0.2, "pull_step_rms_mm_per_min": 0.1 / np.sqrt(50)},
    ),
    "steps of the heater": (
        4, {"Q_H": Q + np.array([1e3, 1e3, -1e3, -1e3])}, {"heater_step_rms_kw": np.sqrt((1 + 0 + 4 + 0) / 4)}),
    **{
        f"mean pull of {factor} v_0": (720, {"v_p": factor * V}, {"mean_pull_within_3pct": share})
        for factor, share in ((1.0299, 1), (0.9701, 1), (1.0301, 0), (0.9699, 0))
    },
    # v_0 for an hour, then 6.01 % more: a window of 360 steps leaves the band when 180 of them are faster.
    "windows of mean pull": (1440, {"v_p": FASTER}, {"mean_pull_within_3pct": (720 + 179 - 359) / (1440 - 359)}),
    "windows up to a failure": (1440, {"lived": 720}, {"mean_pull_within_3pct": (720 - 359) / (1440 - 359)}),
    "no whole window": (1440, {"lived": 300}, {"mean_pull_within_3pct": 0}),
    # From r_1 to r_2: the mean of r^2 is (r_1^2 + r_1 r_2 + r_2^2) / 3.
    "a straight taper": (
        20_001,
        {"r_c": TAPER},
        {"ground_off_pct": 100 * ((0.0880**2 + 0.0880 * 0.0860 + 0.0860**2) / 3 / 0.0860**2 - 1)},
    ),
    # The reward's before it saturates; from a failure on, the radius error of 8 mm alone.
    "cost": (10, TERMS, {"cost": 0.5 * 10}),
    "cost of a lost crystal": (10, {"lived": 4, **TERMS}, {"cost": (7 * 16.0**2 + LIVED) / 10}),
    # Perfect steps, then the failing one and all after it at 8 mm.
    **{
        f"failure in step {steps} of 10": (10, {"lived": steps}, {
            "rmse_mm": (lost := 8 * np.sqrt((11 - steps) / 10)), "rmse_observable_mm": lost, "max_error_mm": 8.0,
            "within_half_mm": (steps - 1) / 10, "failure_rate": 1,
        })
        for steps in (1, 4, 10)
    },
}  # fmt: skip
"""Steps, signals, and the metrics that follow by hand, whole numbers exactly."""


@pytest.mark.parametrize("name", KNOWN)
def test_metrics_are_those_worked_out_by_hand(name):
    steps, signals, expected = KNOWN[name]
    found = of(made_up(steps, **signals))._asdict()
    loose = {"a straight taper": {"rel": 1e-4}, "fooled by the ring": {"abs": 1e-10}}.get(name, {})
    for metric, value in expected.items():
        assert found[metric] == (value if isinstance(value, int) else pytest.approx(value, **loose)), metric


def test_time_at_the_limits_counts_steps_in_which_a_drive_is_at_its_range_or_slew():
    config = make_config("puller", **PLAIN)
    drives = config.sole_scenario.actuators
    steps = np.zeros(20)
    steps[3:6] = drives.pull_slew * DT  # three steps at the slew rate, then back slowly
    steps[6:] = -3.0 / 14.0 * drives.pull_slew * DT
    assert of(made_up(20, scenario="puller", v_p=V + np.cumsum(steps))).time_at_limits == pytest.approx(3 / 20)
    move = np.where(np.arange(20) < 10, 0.0, drives.heater_step)  # slower than its slew rate
    assert of(made_up(20, scenario="puller", Q_H=Q + move)).time_at_limits == 0.0
    # A heater whose slew is two of its steps in one interval: one such move is at the limit, whatever came before.
    coarse = Scenario("coarse", actuators=Actuators(heater_step=100.0, heater_slew=200.0 / DT))
    once = Q + 200.0 * (np.arange(20) >= 10)
    assert of(made_up(20, scenario=coarse, Q_H=once)).time_at_limits == pytest.approx(1 / 20)
    far = Q + np.linspace(0.0, config.heater_range, 200)
    assert of(made_up(200, scenario="puller", Q_H=far)).time_at_limits == pytest.approx(1 / 200)


def test_signals_after_a_failure_do_not_count():
    """The slot goes on with another crystal, or with NaN: no metric reads it."""
    steps, lived = 800, 300
    rng = np.random.default_rng(1)
    told = {
        name: value * rng.uniform(0.99, 1.01, steps) for name, value in (("r_c", R), ("v_p", V), ("v_g", V), ("Q_H", Q))
    }
    after = {name: np.where(np.arange(steps) < lived, value, np.nan) for name, value in told.items()}
    np.testing.assert_array_equal(of(made_up(steps, lived, **told)), of(made_up(steps, lived, **after)))


def test_return_charges_a_lost_crystal_for_what_is_left_and_nothing_else_reads_rewards():
    run = made_up(10, lived=4, r_c=R + 1e-4)
    run.reward[:] = np.arange(10.0)[:, None]
    rewarded, still = of(run), of(made_up(10, lived=4, r_c=R + 1e-4))
    assert (rewarded.return_, still.return_) == (0 + 1 + 2 + 3 - 9 * 6, -9 * 6)
    assert np.isnan(rewarded.rmse_survivors_mm)
    same = {"return_": 0.0, "rmse_survivors_mm": 0.0}
    assert rewarded._replace(**same) == still._replace(**same)


@given(st.floats(0.0, 1e12), st.integers(2, 5000))
def test_to_be_lost_at_once_earns_less_than_any_life(cost, steps):
    lost, lived = made_up(steps, lived=1), made_up(steps)
    lost.reward[0] = reward(Cost(0.0, 0.0, 0.0, 0.0), False)
    lived.reward[:] = reward(Cost(cost, 0.0, 0.0, 0.0), True)
    assert of(lost).return_ < of(lived).return_


def test_cost_gives_the_reward_of_every_step():
    """One step an episode: what the environment paid is the saturated cost."""
    for seed in range(3):
        run = rollout(CompensatedPID(), make_config("randomized", horizon=DT, **PLAIN), [seed])
        found = metrics(run)
        np.testing.assert_allclose(found.return_, 1.0 - 10.0 * found.cost / (10.0 + found.cost), rtol=1e-6)


def test_metrics_of_a_batch_are_those_of_its_episodes():
    config = make_config("hard", horizon=3600.0, **PLAIN)
    batch, *alone = (metrics(rollout(CompensatedPID(), config, seeds)) for seeds in (range(3), [0], [1], [2]))
    np.testing.assert_allclose(np.array(batch), np.hstack(alone), rtol=1e-12, atol=1e-10)


LIMIT = 8 * MM


@pytest.mark.parametrize("stage", ["crown", "tail", pytest.param("whole", marks=pytest.mark.slow)])
def test_energy_and_time_are_those_of_the_recipe(stage):
    """In open loop without disturbances: the power's integral over the time of the recipe, by the mass grown."""
    config = make_config("nominal", observation="measured", action="direct", process=CRYSTAL, stage=stage)
    run = rollout(OpenLoop(), config, [0])
    m = crystal_metrics(run)
    p, table = nominal_recipe(config.parameters._replace(**dict.fromkeys(CRYSTAL.apart, 0.0)), HURLE)
    lengths = run.start.L[0, 0], run.signals.L[run.alive[:, 0], 0][-1]
    t, M_s = ([recipe.look_up(table, *recipe.place(L, p), at) for L in lengths] for at in (recipe._t, recipe._M_s))
    times = np.linspace(*t, 20_000)
    power = np.interp(times, table[:, recipe._t], table[:, recipe._Q_H])
    energy = np.trapezoid(power, times) / 3.6e6  # joule in a kilowatt hour
    assert m.completed[0] == 1.0
    assert m.hours[0] == pytest.approx((t[1] - t[0]) / 3600.0, rel=2e-3)
    assert m.kwh_per_kg[0] == pytest.approx(energy / (M_s[1] - M_s[0]), rel=2e-3)


@pytest.mark.parametrize(
    ("changes", "way"),
    [
        ({"h_c": 0.7 * MM}, "frozen"),
        ({"h_c": 1.0 * MM, "r_c": 87.5 * MM + 6.5 * MM}, "frozen"),
        ({"h_c": 9.3 * MM}, "detached"),
        ({"r_c": 87.5 * MM + 7.9 * MM}, "off"),
        ({"r_c": 2.1 * MM, "r_ref": 9.0 * MM, "L": 0.001}, "off"),
        ({"T_b": 1685.01}, "cold"),
    ],
)
def test_the_nearest_limit_says_how_a_crystal_was_lost(changes, way):
    assert FAILURE_MODES[int(np.argmin(margins(**changes)))] == way


@pytest.mark.parametrize(
    ("changes", "way"),
    [
        ({"h_c": 0.6 * MM}, "frozen"),
        ({"r_c": 95.5 * MM}, "off"),
        ({"r_c": 99.5 * MM, "L": 0.05}, "off"),
        ({"r_c": 2.0 * MM, "r_ref": 3.0 * MM, "L": 0.001}, "off"),
        ({"T_b": 1685.0}, "cold"),
    ],
)
def test_a_margin_is_zero_at_its_limit(changes, way):
    assert margins(**changes)[FAILURE_MODES.index(way)] == pytest.approx(0.0, abs=1e-12)


def margins(**changes):
    at = CRYSTAL.Logged(*[np.nan] * len(CRYSTAL.Logged._fields))._replace(
        **{"r_c": 87.5 * MM, "r_ref": 87.5 * MM, "h_c": 6.6 * MM, "L": 0.5, "T_b": 1690.0} | changes
    )
    return relative_margin(at, LIMIT, make_config(process=CRYSTAL).parameters)


class Stops:
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.tile(np.array([-1.0, 0.0], np.float32), (len(observation), 1)), state


@pytest.mark.parametrize(("stage", "part"), [(0.05, "crown"), (0.3, "body"), (1.15, "tail")])
def test_a_crystal_is_lost_in_the_part_where_it_grew(stage, part):
    config = make_config("randomized", observation="measured", action="direct", process=CRYSTAL, stage=stage)
    m = crystal_metrics(rollout(Stops(), config, TEST_SEEDS[:3]))
    found = {each: getattr(m, f"lost_in_{each}").tolist() for each in ("crown", "body", "tail")}
    assert found == {each: [float(each == part)] * 3 for each in found}


def test_a_frozen_crown_counts_once_and_with_the_largest_allowed_error():
    """With a pull speed that is much too low a crown freezes within minutes."""
    config = make_config("randomized", observation="measured", action="direct", process=CRYSTAL, stage=0.05)
    m = crystal_metrics(rollout(Stops(), config, TEST_SEEDS[:3]))
    for name, value in (("lost_in_crown", 1), ("frozen", 1), ("failure_rate", 1), ("completed", 0), ("detached", 0)):
        np.testing.assert_array_equal(getattr(m, name), value)
    np.testing.assert_array_equal(m.crown_max_mm, 12.0)
    assert np.isnan([m.body_within_half, m.tail_max_mm, m.dopant_spread]).all()
    assert (m.hours < 0.3).all()


def test_a_crystal_is_known_after_its_settings_went_to_another_process():
    settings = make_config("nominal", None, "measured", action="direct", process=CRYSTAL, stage="tail")
    config = pickle.loads(pickle.dumps(settings))
    run = rollout(OpenLoop(), config, [1])
    assert run.config.process == CRYSTAL
    assert (crystal_metrics(run).lost_in_crown == 0.0).all()
