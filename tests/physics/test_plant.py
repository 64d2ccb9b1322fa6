"""The plant: schedules, refused parameters, the integrator at the edge; the page's contract of physics, row by row."""

import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cz_gym import HURLE, SCENARIOS, CzEnv, CzVectorEnv, Parameters, make_puller
from cz_gym.body.process import OUTPUTS, accept_substep, linearise, radius_model
from cz_gym.config import make_config
from cz_gym.crystal.process import APART, CRYSTAL, lengths, nominal_recipe
from cz_gym.crystal.recipe import RecipeRow
from cz_gym.episodes.draw import Episode, Factors, episode_from_key, new_series, randomised
from cz_gym.episodes.scenarios import TRACED_SLOPE
from cz_gym.physics import plant as schedules
from cz_gym.physics.parameters import MACHINE, SIZES, check_parameters
from cz_gym.physics.plant import HEIGHT_MIN, Disturbance, State, disturbance, drift, quintic, recipe, reference, rk4
from cz_gym.process import Inputs
from cz_gym.support.units import MM
from tests.conftest import ROOT
from tests.equations import Truth, integrated
from tests.observed import PLAIN
from tests.stress.__main__ import KINDS, WIDE, Adversaries, Broken, Watch, campaign, cases

THREE_HOURS = 10800.0


def test_quintic_has_no_rate_and_no_curvature_at_its_ends():
    s = np.polynomial.Polynomial([0, 0, 0, 10, -15, 6])
    points = np.linspace(0, 1, 101)
    np.testing.assert_allclose(quintic(points), s(points), atol=1e-15)
    for ends in (s.deriv(1), s.deriv(2)):
        assert ends(np.array([0.0, 1.0])) == pytest.approx([0.0, 0.0], abs=1e-12)
    assert (quintic(0.0), quintic(1.0)) == (0.0, 1.0)


STEPS = Episode(
    recipe_start=600.0, recipe_duration=300.0, recipe_amount=2.0,
    drift_start=0.0, drift_duration=1000.0, drift_amount=-4.0, drift_rate=0.1 / 60,
    ring_offset=1e-4, bias_drift_start=1000.0, bias_drift_duration=1000.0, bias_drift_amount=-2e-4,
    ripple_amplitude=1e-4, ripple_omega=2 * np.pi / 6.0, ripple_phase=np.pi / 2, pyrometer_drift=2.0,
)  # fmt: skip


@pytest.mark.parametrize(
    ("schedule", "e", "times", "expected"),
    [
        (recipe, "paper-ramp", [0.0, 600.0, 660.0, 900.0, 1200.0, 5400.0], [0.0, 0.0, 0.5, 2.5, 5.0, 5.0]),
        (drift, "paper-ramp", [3600.0], [0.0]),
        (reference, "reference-a", [0.0, 600.0, 1500.0, 2400.0, 10200.0], [0.0, 0.0, -1.25e-3, -2.5e-3, -2.5e-3]),
        (reference, "reference-b", [0.0, 600.0, 1500.0, 2400.0, 10200.0], [0.0, 0.0, -0.25e-3, -0.5e-3, -0.5e-3]),
        (recipe, STEPS, [750.0], [1.0 - 3.0 + 1.25]),
        (drift, STEPS, [2000.0], [-4.0 + 0.1 / 60 * 2000]),
        (schedules.bias_offset, STEPS, [0.0, 1500.0, 9000.0], [1e-4, 0.0, -1e-4]),
        (schedules.ripple, STEPS, [0.0, 3.0, 6.0], [1e-4, -1e-4, 1e-4]),
        (schedules.pyrometer_drift, STEPS, [0.0, THREE_HOURS / 2, THREE_HOURS], [0.0, 1.0, 2.0]),
    ],
)
def test_schedules_have_their_values_at_times(schedule, e, times, expected):
    """The ramp rises 0.5 K/min for ten minutes, references fall over half an hour, a recipe is error and drift."""
    if isinstance(e, str):
        e = episode_from_key(SCENARIOS[e], (1, 2), new_series(10, 10))
    assert schedule(np.array(times), e) == pytest.approx(expected)


def test_disturbance_hides_the_drift_and_melts_the_charge_away():
    p = make_puller()
    e = Episode(drift_duration=100.0, drift_amount=3.0, melt_loss=0.1)
    d = disturbance(THREE_HOURS / 2, 0.7, e, p)
    assert d.Q_d == pytest.approx(schedules.hidden_load(3.0, p))
    assert d.dT_i == 0.7
    assert d.melt == pytest.approx(0.95)
    assert disturbance(2 * THREE_HOURS, 0.0, e, p).melt == pytest.approx(0.9)


REFUSED = [
    ({"alpha_0": 11.0}, r"did you mean 0.191986 \(11 deg\)"),
    ({"v_0": 1.2}, r"did you mean 2e-05 \(1.2 mm/min\)"),
    ({"sigma": 0.0}, "parameter sigma"),
    ({"sigma": 720.0}, r"did you mean 0.72 \(720 mN/m\)"),
    ({"rho_l": 2.57}, r"did you mean 2570 \(2.57 g/cm3\)"),
    ({"r_0": 150.0, "R_cr": 400.0}, r"r_0 = 150 m .* did you mean 0.15 \(150 mm\)"),
    ({"T_m": 1412.0}, "silicon's in degrees Celsius: did you mean 1685"),
    ({"dT_0": 0.001}, r"within 0.01 to 500$"),
    ({"eps": 2.0}, r"parameter eps = 2 must lie within 0.001 to 1: did you mean 0.02 \(2 %\)"),
    ({"T_e": 2000.0}, "must be below T_m = 1685 K"),
    *(({"lam": lam}, r"\[0, 1\]") for lam in (-0.1, 1.5, math.nan)),
]


@given(st.sampled_from(Parameters._fields), st.sampled_from([math.nan, math.inf, -math.inf, -1.0, "0.1", None]))
def test_what_is_not_a_number_is_refused_by_name(name, value):
    with pytest.raises(ValueError, match=rf"^parameter {name} = .*\[") as refusal:
        check_parameters(Parameters()._replace(**{name: value}))
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(("given", "message"), REFUSED)
def test_what_no_puller_can_be_made_of_is_refused(given, message):
    with pytest.raises(ValueError, match=message):
        make_puller(Parameters(**{name: given[name] for name in given if name != "lam"}), given.get("lam", 1.0))


def test_the_ends_of_ranges_are_allowed_and_every_key_ends_in_its_unit():
    assert check_parameters(Parameters(alpha_0=0.0, T_a=200.0, T_e=0.0))
    for quantity in MACHINE.values():
        assert quantity.shown in (quantity.unit, *SIZES[quantity.unit])
        assert all(quantity.holds(end * quantity.size) for end in (quantity.low, quantity.high))
    keys = [MACHINE[symbol].key for symbol in ("r_0", "eps", "kappa_12", "outlier_probability", "k_l", "sigma_SB")]
    assert keys == ["radius_mm", "eps", "kappa_12_W_per_K4", "outlier_probability_percent", "k_l_W_per_mK",
                    "sigma_SB_W_per_m2K4"]  # fmt: skip


# A short campaign, and the integrator against the tightest of SciPy's


def test_crystals_under_attack_keep_every_law():
    """One case in seven: every control interval and nearly every scenario occurs."""
    watches = campaign(cases()[::7], 60_000)
    failures = sum(watch.failures for watch in watches)
    assert sum(watch.episodes for watch in watches) > failures > 100
    assert max(watch.missing_heat for watch in watches) < 1e-3


@pytest.mark.parametrize(
    ("where", "value", "says"),
    [
        ("observation", np.nan, "the observation is not finite"),
        ("observation", 11.0, "the observation is not finite and within"),
        ("reward", np.inf, "the reward is not finite"),
        ("reward", -8.5, "the reward does not follow from the cost"),
        ("terminated", True, "the reward does not follow from the cost"),
        ("truncated", True, "truncated before or after the horizon"),
        ("r_c", np.nan, "info 'r_c' is not finite"),
        ("r_c", 0.2, "beyond a limit and not terminated"),
        ("v_p", 1.0, "the pull speed leaves its range"),
        ("Q_H", -1.0, "the heater cools"),
        ("action_clipped", True, "info 'action_clipped' is wrong"),
        ("T_1", 2000.0, "heat appears or disappears"),
    ],
)
def test_each_violated_invariant_is_reported(where, value, says):
    env = CzVectorEnv(2, "nominal", threads=1, info="all", **PLAIN)
    watch = Watch(env)
    watch.begin(*env.reset(seed=0))
    watch.before()
    actions = np.zeros((2, 2))
    *result, infos = env.step(actions)
    names = ("observation", "reward", "terminated", "truncated")
    known = dict(zip(names, result, strict=True)) | {**infos, "T_1": env._batch.memory.slots["x"]["T_1"]}
    known[where][1] = value
    with pytest.raises(Broken, match=f"step 1, slot 1: {says}"):
        watch.after(actions, *result, infos)


def test_a_heater_never_cools():
    """A small furnace, less than 10 kW at its operating point: no action takes heat out of it."""
    small = Parameters(G_1a=0.5, eps=0.01, C_1=2e4)
    nominal = make_puller(small).Q_H_0
    assert nominal < 10e3
    for scenario in ("nominal", "puller"):
        env = CzEnv(scenario, parameters=small, info="all", **PLAIN)
        env.reset(seed=0)
        powers = [env.step(np.array([0.0, -1.0], np.float32))[4]["Q_H"] for _ in range(100)]
        assert min(powers) == 0.0


def _visited(n):
    """States and drives that adversaries reach on wide pullers, the last before failures among them."""
    env = CzVectorEnv(2 * len(KINDS), WIDE, horizon=3600.0, threads=1, info="all", **PLAIN)
    slots, adversaries = env._batch.memory.slots, Adversaries(2 * len(KINDS), 5)
    _, infos = env.reset(seed=11)
    found = []
    for step in range(400):
        old = slots.copy()
        *_, terminated, _, infos = env.step(adversaries.actions(infos, slots["puller"]["h_0"]))
        for i in range(env.num_envs):
            if terminated[i] or (step + i) % 7 == 0:
                p = make_puller()._replace(**{f: float(old["puller"][f][i]) for f in make_puller()._fields})
                d = Disturbance(float(slots["Q_d"][i]), float(slots["dT_i"][i]), 1.0)
                u = Inputs(float(slots["v_p"][i]), float(slots["Q_H"][i]))
                found.append((State(*map(float, old["x"][i])), u, d, p))
    return found[:: max(1, len(found) // n)]


def _error(x, u, d, p, dt):
    """Relative error of one RK4 step against DOP853 at its tightest."""
    exact = integrated(x, Truth(*u, *d), p, dt, atol=1e-16).y[:, -1]
    return float(np.abs(np.array(rk4(x, u, d, p, dt, HURLE.slope)) / exact - 1).max())


@pytest.mark.slow
def test_steps_from_states_that_adversaries_reach_are_exact_enough():
    states = _visited(75)
    assert len(states) >= 50
    worst = {True: 0.0, False: 0.0}
    for x, u, d, p in states:
        regular = 4.0 * MM <= x.h_c <= p.a
        worst[regular] = max(worst[regular], _error(x, u, d, p, 5.0))
    assert worst[True] < 2e-8
    assert worst[False] < 2e-4


@pytest.mark.parametrize(("excess", "bound"), [(-5.0, 1e-4), (-8.0, 1e-4), (-13.0, 5e-4), (-20.0, np.inf)])
@pytest.mark.parametrize("pull", [0.0, 2.0])
@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")
def test_a_meniscus_that_freezes_within_a_step_ends_the_episode(excess, bound, pull):
    """Over a cold melt a meniscus freezes within seconds: the exact solution reaches 1.2 mm, and so does the step.

    Adversaries reach 13 K below freezing on "hard". A step that a crystal just survives there, ending at 1.2 mm, is the
    least exact of all. Across the singularity the trial steps of both methods meet roots of negative numbers.
    """
    p, fates, worst = make_puller(), set(), 0.0
    d, u = Disturbance(0.0, 0.0, 1.0), Inputs(pull * p.v_0, p.Q_H_0)
    for height in np.arange(1.2, 2.6, 0.02):
        x = State(p.r_0, height * MM, p.T_1_0 - 60.0, p.T_2_0 - 40.0, p.T_m + excess)
        new, grows = accept_substep(x, rk4(x, u, d, p, 5.0, HURLE.slope), u, d, p, 5.0, p.r_0, HURLE.slope)
        solved = integrated(x, Truth(*u), p, 5.0, rtol=1e-12, atol=1e-6, events=_frozen)
        close = abs(solved.y[1, -1] - HEIGHT_MIN) < 5e-3 * MM and solved.t[-1] > 4.9
        assert grows == (solved.status == 0) or close
        assert grows or new.h_c < HEIGHT_MIN or new.h_c == x.h_c
        fates.add(bool(grows))
        if grows:
            worst = max(worst, _error(x, u, d, p, 5.0))
    assert fates == {False, True}
    assert worst < bound


def _frozen(_, y):
    return float(y[1] - HEIGHT_MIN)


_frozen.terminal = True


@pytest.mark.parametrize("lam", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("factor", [0.85, 1.0, 1.15])
@pytest.mark.parametrize("height", [1.2, 2.0, 4.0, 1.0, 1.2399])
def test_a_longest_substep_at_the_limits_with_extreme_drives(lam, factor, height):
    """The corners of "hard": pullers at their spread, the radius lost, melt hot or cold, drives at their ends.

    But a low meniscus over a hot melt, which adversaries do not reach: at 1.2 mm in pure conduction 2.5 K of superheat
    already melt it back, and a melt needs minutes to gain more. In 1.6 million adversarial steps on "nominal", "hard"
    and "puller" the largest error from below 1.5 mm over a melt hotter than nominal was 2e-8. So it is nominal there.
    """
    f = Factors(lam, 1.0 + 0.3 * (factor - 1.0), factor, factor, factor, factor, factor)
    p = make_puller(randomised(Parameters(), f), lam)
    h_c = height * MM if height in (1.2, 2.0, 4.0) else height * p.a
    for side in (-1.0, 1.0):
        hot = 0.0 if height == 1.2 and side > 0.0 else side
        x = State(p.r_0 + side * 8.0 * MM, h_c, p.T_1_0 + 60.0 * side, p.T_2_0 + 40.0 * side, p.T_b_0 + 5.0 * hot)
        bound = 2e-8 if height in (4.0, 1.0) else 1e-4
        for pull in (0.0, 2.0):
            u = Inputs(pull * p.v_0, p.Q_H_0 - 10e3 * side)
            assert _error(x, u, Disturbance(800.0 * side, 1.5 * hot, 0.9), p, 5.0) < bound


# The contract of physics: each row of the page's table against the code, agreements and known misses alike

PAGE = (ROOT / "docs" / "physics.md").read_text()
TABLE = PAGE.split("## The contract of physics")[1].split("\n\n## ")[0]
LINES = (line for line in TABLE.splitlines() if line.startswith("| ") and "quantity" not in line)
ROWS = [[cell.strip() for cell in line.strip("| ").split(" | ")] for line in LINES]
LAYER, TRACED = Parameters(R=7e-4), make_puller(Parameters(phi_b=TRACED_SLOPE))
SILICON = 22.0
"""Conductivity of the crystal at its melting point [W/m/K]."""


def superheat(q):
    p = make_puller(q)
    return p.T_b_0 - p.T_m


def flux(q):
    """Nominal flux from the melt [W/m2], from its definition with a resistance."""
    p = make_puller(q)
    return superheat(q) / (p.h_0 / p.k_l + q.R)


def flux_by_wall(q):
    """Flux that a kelvin of the crucible's wall adds, in balance, the meniscus held [W/m2/K]."""
    p = make_puller(q)
    melt = linearise(p)
    by_flux = p.k_l / (p.h_0 + p.layer)
    warms = -melt.A[4, 3] / melt.A[4, 4]  # the melt's balance: 0 = A_bb dT_b + A_b2 dT_2
    return by_flux * warms


def body():
    """The recipe in the body, without 100 mm at either end."""
    config = make_config("nominal", process=CRYSTAL, stage="whole")
    p, table = nominal_recipe(config.parameters._replace(**dict.fromkeys(APART, 0.0)), config.meniscus)
    at, L = RecipeRow(*table.T), lengths(p)
    inside = (p.crown_length + 0.1 <= L) & (p.crown_length + p.body_length - 0.1 >= L)
    return RecipeRow(*(column[inside] for column in at))


def warming():
    at = body()
    return 60.0 * (at.T_1[-1] - at.T_1[0]) / (at.t[-1] - at.t[0])


def energy():
    at = body()
    return np.trapezoid(at.Q_H, at.t) / 3.6e6 / (at.M_s[-1] - at.M_s[0])


def ring_gain(**changes):
    return linearise(make_puller(Parameters(**changes))).C[OUTPUTS.index("r_br"), 1]


ONE, TWO = radius_model(make_puller(lam=1.0)), radius_model(make_puller(lam=0.0))
OURS = {
    "numerator of $G_p$, Model II [1/s]": lambda: TWO.numerator,
    "numerator of $G_p$, Model I [1/s]": lambda: ONE.numerator,
    "pole of the height, Model I [rad/s]": lambda: ONE.poles[1],
    "pole of the cone angle, Model I [rad/s]": lambda: ONE.poles[0],
    "lead of $G_m$, Model II [s]": lambda: TWO.lead,
    "lead of $G_m$, Model I [s]": lambda: ONE.lead,
    "right-half-plane zero, Model II [rad/s]": lambda: TWO.zero,
    "right-half-plane zero, traced ring [rad/s]": lambda: radius_model(TRACED).zero,
    "ring outside the crystal [mm]": lambda: 1e3 * make_puller().ring_bias,
    "the same, `randomized-traced` [mm]": lambda: 1e3 * TRACED.ring_bias,
    "ring by the height [-]": ring_gain,
    "the same, `randomized-traced` [-]": lambda: ring_gain(phi_b=TRACED_SLOPE),
    "nominal meniscus height [mm]": lambda: 1e3 * make_puller().h_0,
    "growth angle [deg]": lambda: np.degrees(Parameters().alpha_0),
    "density of the melt [kg/m³]": lambda: Parameters().rho_l,
    "emissivity of the melt [-]": lambda: Parameters().eps,
    "flux at the interface per superheat of the meniscus [kW/m²/K]": lambda: flux(Parameters()) / 5.02e3,
    "melt above its melting point [K]": lambda: superheat(Parameters()),
    "the same, `melt-layer` [K]": lambda: superheat(LAYER),
    "resistance between melt and interface [1e-4 m²K/W]": lambda: 1e4 * superheat(Parameters()) / flux(Parameters()),
    "the same, `melt-layer` [1e-4 m²K/W]": lambda: 1e4 * superheat(LAYER) / flux(LAYER),
    "flux by the wall's temperature [W/m²/K]": lambda: flux_by_wall(Parameters()),
    "the same, `melt-layer` [W/m²/K]": lambda: flux_by_wall(LAYER),
    "gradient in the crystal at the interface [K/mm]": lambda: make_puller().Phi_s / SILICON / 1e3,
    "heater at 57.6 kW [K]": lambda: make_puller().T_1_0,
    "rise of the heater over the body [K/min]": warming,
    "energy in the body, without melting down [kWh/kg]": energy,
}
"""Each row's number from the code."""


def test_the_table_has_a_row_for_each_number():
    assert [row[0] for row in ROWS] == list(OURS)


@pytest.mark.parametrize("row", ROWS, ids=[row[0] for row in ROWS])
def test_a_row_is_what_the_code_computes(row):
    """The number with the page's digits; "agrees" within its band, else the distance from the band's nearest end."""
    what, shown, _, band, verdict, _ = row
    value = float(OURS[what]())
    digits = len(re.sub(r"e.*", "", shown).lstrip("-0.").replace(".", ""))
    assert float(f"{value:.{digits}g}") == pytest.approx(float(shown), rel=1e-12), value
    ends = [float(end) for end in band.split(" to ")]
    nearest = min(ends, key=lambda end: abs(value - end))
    inside = min(ends) <= value <= max(ends)
    miss = f"miss: {100.0 * (value / nearest - 1.0):+.1f} %"
    assert verdict == ("agrees" if inside else miss)


def test_the_layer_changes_no_flux_at_the_interface():
    assert flux(LAYER) == pytest.approx(flux(Parameters()), rel=1e-12)
