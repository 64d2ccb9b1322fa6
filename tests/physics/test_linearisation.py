"""Linearisation against published transfer functions, finite differences and the simulated plant."""

import numpy as np
import pytest

from cz_gym import make_puller
from cz_gym.body.process import linearise, radius_model
from cz_gym.physics.meniscus import HURLE
from cz_gym.physics.plant import NO_DISTURBANCE, State, rates
from cz_gym.process import Inputs
from cz_gym.support.units import MM


@pytest.mark.parametrize(("lam", "second_pole"), [(1.0, -1.684e-3), (0.0, 0.0)])
def test_published_transfer_functions(lam, second_pole):
    model = radius_model(make_puller(lam=lam))
    assert model.numerator == pytest.approx(-0.0048849, rel=1e-3)
    assert model.poles[0] == pytest.approx(8.78e-6, rel=6e-3)
    assert model.poles[1] == pytest.approx(second_pole, rel=1e-3, abs=1e-18)
    assert model.lead == pytest.approx(-46.0050, rel=5e-4)
    assert model.constant == pytest.approx(1.0041, abs=5e-4)
    assert model.zero == pytest.approx(0.0218, abs=5e-5)


def test_complex_step_against_finite_differences():
    p = make_puller(lam=0.4)
    x = State(p.r_0 + 1.0 * MM, p.h_0 - 0.5 * MM, p.T_1_0 + 3.0, p.T_2_0 - 2.0, p.T_b_0 + 1.0)
    u = Inputs(0.9 * p.v_0, p.Q_H_0 + 500.0)
    model = linearise(p, x=x, u=u, d=NO_DISTURBANCE._replace(Q_d=300.0, dT_i=0.5))
    point = np.array([*x, *u, 300.0, 0.5])
    for j in range(len(point)):
        step = 1e-5 * abs(point[j])
        sides = []
        for sign in (1.0, -1.0):
            at = point.copy()
            at[j] += sign * step
            d = NO_DISTURBANCE._replace(Q_d=at[7], dT_i=at[8])
            sides.append(np.array(rates(State(*at[:5]), Inputs(*at[5:7]), d, p, HURLE.slope)))
        column = (sides[0] - sides[1]) / (2.0 * step)
        np.testing.assert_allclose(np.hstack([model.A, model.B])[:, j], column, rtol=2e-6, atol=1e-12)
