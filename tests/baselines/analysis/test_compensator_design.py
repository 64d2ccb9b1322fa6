"""The design procedure against the paper's printed constants, partial fractions and the loop itself."""

import math

import numpy as np
import pytest
from scipy.signal import invres, residue

from cz_gym import make_puller
from cz_gym.baselines.analysis import design_compensator, margins
from cz_gym.body.process import radius_model
from cz_gym.support.errors import CzError
from studies.paper.experiments import COMPENSATOR, MODEL_I, MODEL_II, PID


def test_printed_compensator_to_five_digits():
    found = design_compensator(MODEL_I)
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
    found = design_compensator(model, cut_off)
    assert found.gain == pytest.approx(stable[0].real, rel=1e-8)
    assert np.poly([-found.fast, -found.slow]) == pytest.approx(denominator.real, rel=1e-8)


def test_a_plant_without_compensator_and_a_bad_cut_off_are_refused():
    for said, *given in (("two stable", MODEL_II), ("two stable", MODEL_I, -MODEL_I.poles[1]), ("cut", MODEL_I, 0.0)):
        with pytest.raises(CzError, match=said):
            design_compensator(*given)


@pytest.mark.parametrize(("model", "crossover", "phase"), [(MODEL_I, 0.030, 79.0), (MODEL_II, 0.029, 76.0)])
def test_margins_of_the_published_loop(model, crossover, phase):
    """And the definition of a margin, evaluated by hand; without the compensator the loop is unstable."""
    found = margins(model, COMPENSATOR, PID)
    assert found.stable
    assert not margins(model, None, PID).stable
    assert found.crossover == pytest.approx(crossover, abs=5e-4)
    assert found.phase_margin_deg == pytest.approx(phase, abs=0.5)
    s, pid = 1j * found.crossover, PID
    K = pid.K_p * (pid.T_i * s + 1) * (pid.T_d * s + 1) / (pid.T_i * s * (1 + pid.T_d * s / pid.N))
    ring = model.numerator * (model.lead * s + model.constant) / ((s - model.poles[0]) * (s - model.poles[1]))
    L = -K * (ring + COMPENSATOR.gain * s / ((s + COMPENSATOR.fast) * (s + COMPENSATOR.slow)))
    assert abs(L) == pytest.approx(1.0, rel=1e-6)
    assert 180.0 + math.degrees(np.angle(L)) == pytest.approx(found.phase_margin_deg, abs=1e-4)
