"""Sampled loops and their margins: python-control's own algebra, closed forms, the simulated plant, and loops that
changes destabilise.
"""

import math
from dataclasses import replace
from itertools import product

import control
import numpy as np
import pytest
from scipy.signal import invres, residue

from cz_gym import Parameters, make_puller
from cz_gym.baselines import OpenLoop, margins
from cz_gym.baselines import analysis as loops
from cz_gym.baselines.analysis import NO_LAGS, Lags, close, linear_controller, linear_form, loop_margins
from cz_gym.baselines.margins import MarginLimits, lags_of, margin_of, openings, worst_margins
from cz_gym.baselines.pid import CompensatedPID, FilteredPID
from cz_gym.baselines.tuned_controllers import FAMILY
from cz_gym.body.process import radius_model
from cz_gym.body.signals import Measured
from cz_gym.config import make_config
from cz_gym.episodes.scenario import Scenario, Sensor
from cz_gym.evaluation.rollout import rollout
from cz_gym.process import StateSpace
from cz_gym.spaces import MEASURED
from cz_gym.support.units import MM
from cz_gym.tools.registry import make_controller
from studies.paper.experiments import COMPENSATOR, MODEL_I, MODEL_II, PID
from tests.observed import PLAIN
from tests.samples import NOMINAL_LQG

PAPER = CompensatedPID()
OMEGA = np.geomspace(1e-4, 0.5, 60)
RANDOMIZED, PULLER = (make_config(name, **PLAIN) for name in ("randomized", "puller"))
CASES = [(name, config) for config in (RANDOMIZED, PULLER) for name in ("paper-tuned", "lqg", "lqg-at-0.02")]


@pytest.mark.parametrize("lam", [1.0, 0.0])
@pytest.mark.parametrize("dt", [2.0, 5.0, 10.0])
def test_loop_of_the_running_code_is_the_textbook_loop(lam, dt):
    """The textbook's melt temperature is constant: a melt of endless heat capacity."""
    puller, z = make_puller(lam=lam)._replace(C_b=1e18), np.exp(1j * OMEGA * dt)
    tustin = 2.0 / dt * (z - 1.0) / (z + 1.0)
    K = loops.controller_transfer(PAPER.pid)(tustin)
    plant, s = radius_model(puller), control.tf("s")
    growth = plant.numerator / ((s - plant.poles[0]) * (s - plant.poles[1]))
    ring = control.sample_system((plant.lead * s + plant.constant) * growth, dt, "zoh")(z)
    compensator = control.ss([[-PAPER.compensator.fast, 1.0], [0.0, -PAPER.compensator.slow]], [[0.0], [1.0]],
                             PAPER.compensator.gain * np.array([[-PAPER.compensator.fast, 1.0]]), 0.0)  # fmt: skip
    added = control.sample_system(compensator, dt, "zoh")(z)
    controller = linear_controller(CompensatedPID(control_interval=dt))
    found = loops.response(loops.opened(controller, puller, dt, "v_p"), dt, OMEGA)
    np.testing.assert_allclose(found, -K * (ring + added), rtol=1e-5)
    # Opened at the camera, what the compensator feeds back belongs to the controller.
    found = loops.response(loops.opened(controller, puller, dt, "camera"), dt, OMEGA)
    np.testing.assert_allclose(found, -K * ring / (1.0 - K * added), rtol=1e-5)


def scaled(controller, factor):
    """The controller reading the camera with another gain."""
    B, D = controller.B.copy(), controller.D.copy()
    B[:, 0] *= factor
    D[:, 0] *= factor
    return StateSpace(controller.A, B, controller.C, D)


def late(controller, samples):
    """The controller reading the camera that many samples late."""
    camera = np.zeros((1, controller.B.shape[1]))
    camera[0, 0] = 1.0
    for _ in range(samples):
        A, B, C, D = controller
        A = np.block([[A, B @ camera.T], [np.zeros((1, len(A) + 1))]])
        B, C = np.vstack([B * (1.0 - camera), camera]), np.hstack([C, D @ camera.T])
        controller = StateSpace(A, B, C, D * (1.0 - camera))
    return controller


@pytest.mark.parametrize("policy", [PAPER, FilteredPID(T_f=20.0)])
@pytest.mark.parametrize("lam", [1.0, 0.0])
def test_margins_are_where_the_closed_loop_turns_unstable(policy, lam):
    puller, controller = make_puller(lam=lam), linear_controller(policy)
    found = loop_margins(controller, puller, 5.0)
    assert close(scaled(controller, 0.98 * found.gain_up), puller, 5.0).stable
    assert not close(scaled(controller, 1.02 * found.gain_up), puller, 5.0).stable
    too_late = math.ceil(found.delay / 5.0 - 1e-6)
    assert close(late(controller, too_late - 1), puller, 5.0).stable
    assert not close(late(controller, too_late), puller, 5.0).stable


def test_the_linear_form_of_an_lqg_has_the_noise_of_the_camera_that_it_is_given():
    lqg = make_controller("lqg", make_config("randomized", **PLAIN))
    sensors = [Sensor(camera_noise=(sd, sd), pyrometer_noise=(0.2, 0.2)) for sd in (0.01 * MM, 0.1 * MM)]
    quiet, loud = (np.abs(linear_form(lqg, sensor).controller.D[0, 0]) for sensor in sensors)
    assert 0.0 < loud < 0.5 * quiet


def test_a_range_of_hot_zones_ends_where_the_loop_turns_unstable():
    form = linear_form(NOMINAL_LQG)
    low, high = loops.stable_range(form.controller, 5.0, "C_2", 0.5)
    for factor, stable in ((0.99 * low, False), (1.01 * low, True), (0.99 * high, True), (1.01 * high, False)):
        puller = make_puller(Parameters(C_2=factor * Parameters().C_2), 0.5)
        assert close(form.controller, puller, 5.0).stable == stable
    assert high < 1.4


@pytest.mark.parametrize("name", ["lqg", *FAMILY])
def test_lqgs_survive_hot_zone_parameters_of_half_and_twice_the_design_value(name):
    form, design = linear_form(make_controller(name, make_config("randomized", **PLAIN))), Parameters()
    for lam, parameter, factor in product((0.0, 1.0), loops.HOT_ZONE.values(), (0.5, 2.0)):
        other = design._replace(**{parameter: factor * getattr(design, parameter)})
        assert close(form.controller, make_puller(other, lam), 5.0).stable


def test_an_unstable_loop_has_no_margins():
    plain = CompensatedPID(compensator=None)
    found = loop_margins(linear_controller(plain), make_puller(), 5.0)
    assert math.isfinite(found.crossover)
    assert all(math.isnan(value) for value in found[1:])
    assert worst_margins(plain, RANDOMIZED) == margins.Openings(*[margins.NO_MARGIN] * 3)
    assert MarginLimits().slacks(worst_margins(plain, RANDOMIZED)) == (-2.0, -2.0, -2.0)


def test_noise_gains_are_those_of_the_simulated_plant():
    policy = FilteredPID(T_f=30.0)
    quiet = Scenario("camera-noise", sensor=Sensor(camera_noise=(0.002 * MM, 0.002 * MM)))
    run = rollout(policy, make_config(quiet, "I", **PLAIN), range(40))
    controller = linear_controller(policy)
    loop = control.ss(*close(controller, make_puller(), 5.0).pick("v_p", ("camera",)), 5.0)
    kick = control.impulse_response(loop, T=5.0 * np.arange(2000)).y[0, 0] * 5.0  # python-control's has area 1
    v_p = run.signals.v_p[200:] - make_puller().v_0
    for power, gains in ((v_p, kick), (np.diff(v_p, axis=0), np.diff(kick, prepend=0.0))):
        assert np.std(power) / (0.002 * MM) == pytest.approx(np.linalg.norm(gains), rel=0.03)


def test_controllers_that_are_not_linear_are_named():
    def changed(change):
        class Changed(FilteredPID):
            def predict(self, *args, **kwargs):
                action, memory = super().predict(*args, **kwargs)
                return change(action), memory

        return Changed()

    with pytest.raises(loops.NotLinearError, match="Changed does not rest"):
        linear_controller(changed(lambda action: action + np.float32(0.1)))
    with pytest.raises(loops.NotLinearError, match="Changed is not linear"):
        linear_controller(changed(lambda action: np.sign(action) * np.square(action)))
    with pytest.raises(loops.NotLinearError, match="no loop"):
        linear_form(OpenLoop())


def test_anti_windup_is_set_aside_where_the_loop_is_opened_at_the_drive():
    form = linear_form(FilteredPID(T_track=20.0))
    expected = linear_controller(replace(FilteredPID(), T_track=np.inf))
    np.testing.assert_array_equal(form.free.A, expected.A)
    assert not np.array_equal(form.controller.A, form.free.A)


# The design procedure against the paper's printed constants, partial fractions and the loop itself


def test_printed_compensator_to_five_digits():
    found = loops.design_compensator(MODEL_I)
    assert f"{found.gain:.5f}" == "-0.22517"
    assert found.fast == pytest.approx(1.684e-3, rel=1e-9)
    assert found.slow == pytest.approx(2e-4, rel=1e-9)


@pytest.mark.parametrize("model", [MODEL_I, radius_model(make_puller(lam=1.0)), radius_model(make_puller(lam=0.7))])
@pytest.mark.parametrize("cut_off", [2e-4, 5e-3])
def test_compensator_is_the_ideal_one_but_for_unstable_poles_and_steady_gain(model, cut_off):
    """SciPy's partial fractions of G_p (1 - G_m) s/(s + cut_off): the stable ones, put together again."""
    n, (p_0, p_1), lead, constant = model
    numerator = -n * lead * np.poly([0.0, (1.0 - constant) / lead])
    residues, poles, _ = residue(numerator, np.poly([p_0, p_1, -cut_off]), tol=1e-9)
    stable, denominator = invres(residues[poles.real < 0.0], poles[poles.real < 0.0], [], tol=1e-9)
    found = loops.design_compensator(model, cut_off)
    assert found.gain == pytest.approx(stable[0].real, rel=1e-8)
    assert np.poly([-found.fast, -found.slow]) == pytest.approx(denominator.real, rel=1e-8)


@pytest.mark.parametrize(("model", "crossover", "phase"), [(MODEL_I, 0.030, 79.0), (MODEL_II, 0.029, 76.0)])
def test_margins_of_the_published_loop(model, crossover, phase):
    """And the definition of a margin, evaluated by hand; without the compensator the loop is unstable."""
    found = loops.margins(model, COMPENSATOR, PID)
    assert found.stable
    assert not loops.margins(model, None, PID).stable
    assert found.crossover == pytest.approx(crossover, abs=5e-4)
    assert found.phase_margin_deg == pytest.approx(phase, abs=0.5)
    s, pid = 1j * found.crossover, PID
    K = pid.K_p * (pid.T_i * s + 1) * (pid.T_d * s + 1) / (pid.T_i * s * (1 + pid.T_d * s / pid.N))
    ring = model.numerator * (model.lead * s + model.constant) / ((s - model.poles[0]) * (s - model.poles[1]))
    L = -K * (ring + COMPENSATOR.gain * s / ((s + COMPENSATOR.fast) * (s + COMPENSATOR.slow)))
    assert abs(L) == pytest.approx(1.0, rel=1e-6)
    assert 180.0 + math.degrees(np.angle(L)) == pytest.approx(found.phase_margin_deg, abs=1e-4)


# The three openings against closed forms, python-control, and the loops that the changes destabilise


def form_of(name, config):
    return linear_form(make_controller(name, config), config.scenario.sensor)


def gains_of(form, puller, lags, points=400):
    """Frequencies and loop gains of a controller's loop."""
    omega = np.geomspace(1e-5, np.pi / form.dt, points)
    z = np.exp(1j * omega * form.dt)
    A, B, C, D = form.controller
    controller = margins.frequency_response(StateSpace(A, B[:, loops.SEEN], C, D[:, loops.SEEN]), z)
    return omega, margins.loop_gains(controller, loops.sampled_plant(puller, form.dt, lags), z)


@pytest.mark.parametrize("damping", [0.1, 0.4, 0.7])
def test_a_second_order_loop_has_the_margins_of_the_textbook(damping):
    """L = 1 / (s (s + 2 d)): the closed loop is a second-order system of that damping."""
    omega = np.geomspace(1e-3, 1e3, 4000)
    s = 1j * omega
    found = margin_of(1.0 / (s * (s + 2.0 * damping)), omega)
    crossover = math.sqrt(math.sqrt(1.0 + 4.0 * damping**4) - 2.0 * damping**2)
    phase = math.atan2(2.0 * damping, crossover)
    assert (found.gain_up, found.gain_down) == (math.inf, 0.0)
    assert found.phase == pytest.approx(math.degrees(phase), rel=1e-4)
    assert found.delay == pytest.approx(phase / crossover, rel=1e-4)
    square = omega**2
    peak = np.sqrt((square**2 + 4 * damping**2 * square) / ((1 - square) ** 2 + 4 * damping**2 * square)).max()
    assert found.peak == pytest.approx(peak, rel=1e-9)


def test_a_loop_that_nothing_moves_has_every_margin():
    assert margin_of(np.zeros(9), np.arange(1.0, 10.0), 5.0) == (math.inf, 0.0, 180.0, math.inf, 1.0)


@pytest.mark.parametrize(("name", "config"), CASES)
@pytest.mark.parametrize("lam", [pytest.param(1.0, marks=pytest.mark.slow), 0.0])
def test_margins_are_python_controls(name, config, lam):
    form, lags = form_of(name, config), lags_of(config)
    omega, gains = gains_of(form, make_puller(lam=lam), lags, 4000)
    (found,) = openings(form, [make_puller(lam=lam)], lags, 4000)
    for L, ours in zip(gains, found, strict=True):
        up, phase, _, _, crossing, _ = control.stability_margins(control.frd(L, omega), returnall=True)
        # A table of frequencies does not say that the loop's gain is real at its end, Nyquist's frequency.
        up = np.append(up, -1.0 / L[-1].real) if L[-1].real < 0.0 else up
        assert ours.gain_up == pytest.approx(min(up[up > 1.0], default=math.inf), rel=2e-3)
        assert ours.gain_down == pytest.approx(max(up[up < 1.0], default=0.0), rel=2e-3, abs=1e-3)
        assert ours.phase == pytest.approx(np.abs(phase).min(initial=180.0), abs=0.05)
        late = np.radians(np.mod(phase, 360.0)) / crossing
        assert ours.delay == pytest.approx(late.min(initial=math.inf), rel=2e-3)
        assert ours.peak == pytest.approx((1.0 / np.abs(1.0 + L)).max())


@pytest.mark.parametrize(("name", "config"), CASES)
def test_without_lags_ring_and_heater_are_opened_as_the_loop_in_state_space_is(name, config):
    form, puller = form_of(name, config), make_puller(lam=0.5)
    omega, gains = gains_of(form, puller, NO_LAGS)
    for at, L in (("camera", gains[2]), ("Q_H", gains[1])):
        np.testing.assert_allclose(
            loops.response(loops.opened(form.controller, puller, form.dt, at), form.dt, omega), L, rtol=1e-5
        )


def test_lags_turn_the_plant_as_their_transfer_functions_do():
    omega, dt, puller = np.geomspace(1e-5, 1e-2, 20), 5.0, make_puller()
    z, s = np.exp(1j * omega * dt), 1j * omega
    plain = margins.frequency_response(loops.sampled_plant(puller, dt), z)
    found = margins.frequency_response(loops.sampled_plant(puller, dt, Lags(7.0, 45.0, 12.0, 20.0)), z) / plain
    ring, warmth, heat = np.exp(-7.0 * s), 1.0 / (1.0 + 20.0 * s), np.exp(-12.0 * s) / (1.0 + 45.0 * s)
    for row, column, expected in ((0, 0, ring), (0, 1, ring * heat), (1, 0, warmth), (1, 1, warmth * heat)):
        np.testing.assert_allclose(found[:, row, column], expected, rtol=5e-3)


def driven(controller, drive, factor):
    """The controller with a drive of that many times the effect, which it does not know."""
    A, B, C, D = (part.copy() for part in controller)
    effect, shown = np.ones((2, 1)), np.ones(len(MEASURED))
    effect[drive], shown[Measured._fields.index(("v_p", "Q_H")[drive])] = factor, 1.0 / factor
    return StateSpace(A, B * shown, effect * C, effect * D * shown)


@pytest.mark.parametrize(("name", "config"), CASES)
@pytest.mark.parametrize("drive", [0, 1])
def test_the_loop_turns_unstable_where_a_drive_has_more_or_less_effect_than_the_margin(name, config, drive):
    form, puller, lags = form_of(name, config), make_puller(lam=0.0), lags_of(config)
    (found,) = openings(form, [puller], lags)
    for factor, inward in ((found[drive].gain_up, 0.98), (found[drive].gain_down, 1.02)):
        if 0.0 < factor < math.inf:
            assert close(driven(form.controller, drive, inward * factor), puller, form.dt, lags=lags).stable
            assert not close(driven(form.controller, drive, factor / inward), puller, form.dt, lags=lags).stable


@pytest.mark.parametrize(("name", "config"), CASES)
def test_the_loop_turns_unstable_where_the_ring_is_later_than_the_margin(name, config):
    form, puller, lags = form_of(name, config), make_puller(lam=0.0), lags_of(config)
    (found,) = openings(form, [puller], lags)
    for factor, stable in ((0.97, True), (1.03, False)):
        late = lags._replace(latency=lags.latency + factor * found.ring.delay)
        assert close(form.controller, puller, form.dt, lags=late).stable == stable


def test_nineteen_of_twenty_drawn_pullers_have_the_margins_of_the_quantile():
    """And the worst draw has no more than any share allows."""
    lqg = make_controller("lqg-at-0.02", RANDOMIZED)
    worst, found = (margins.margin_quantiles(lqg, RANDOMIZED, 20, share) for share in (0.0, 0.05))
    for nominal, place in zip(worst_margins(lqg, RANDOMIZED), range(len(margins.PLACES)), strict=True):
        assert margins.worst_of((worst[place], found[place])) == worst[place]
        assert found[place].gain == pytest.approx(nominal.gain, rel=0.15)


@pytest.mark.parametrize(
    ("text", "limits"), [("2,30,2", MarginLimits()), ("2.5,45,1.7", (2.5, 45.0, 1.7)), ("off", None)]
)
def test_limits_of_margins_are_read(text, limits):
    assert margins.margin_limits(text) == limits


def test_slacks_are_those_of_the_worst_opening():
    lqg = worst_margins(make_controller("lqg", PULLER), PULLER)
    gain, phase, peak = MarginLimits(*(2.0, 30.0, 2.0)).slacks(lqg)
    assert gain == pytest.approx(math.log(min(each.gain for each in lqg) / 2.0))
    assert phase == pytest.approx(min(each.phase for each in lqg) / 30.0 - 1.0)
    assert peak == pytest.approx(math.log(2.0 / max(each.peak for each in lqg)))
