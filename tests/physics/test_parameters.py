import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cz_gym import Parameters, make_puller
from cz_gym.physics.parameters import check_parameters


@given(st.sampled_from(Parameters._fields), st.sampled_from([math.nan, math.inf, -math.inf, -1.0, "0.1", None]))
def test_what_is_not_a_number_is_refused_by_name(name, value):
    with pytest.raises(ValueError, match=rf"^parameter {name} = .*\[") as refusal:
        check_parameters(Parameters()._replace(**{name: value}))
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"alpha_0": 11.0}, r"did you mean 0.191986 \(11 degrees\)"),
        ({"v_0": 1.2}, r"did you mean 2e-05 \(1.2 mm/min\)"),
        ({"sigma": 0.0}, "parameter sigma"),
        ({"sigma": 720.0}, r"did you mean 0.72 \(720 thousandths\)"),
        ({"rho_l": 2.57}, r"did you mean 2570 "),
        ({"r_0": 0.3}, "crucible"),
        ({"r_0": 150.0, "R_cr": 400.0}, r"r_0 = 150 m .* did you mean 0.15 \(150 mm\)"),
        ({"T_m": 1412.0}, "silicon's in degrees Celsius: did you mean 1685"),
        ({"T_a": 25.0}, r"did you mean 298.15 \(25 degrees Celsius\)"),
        ({"phi_b": 3.5}, r"did you mean 0.0610865 \(3.5 degrees\)"),
        ({"eps": 2.0}, r"did you mean 0.02 \(2 %\)"),
        ({"T_e": 2000.0}, "must be below T_m = 1685 K"),
        ({"C_1": 57.0}, r"did you mean 57000 "),
    ],
)
def test_what_no_puller_can_be_made_of_is_refused(given, message):
    with pytest.raises(ValueError, match=message):
        make_puller(Parameters(**given))
    assert check_parameters(Parameters(alpha_0=0.0, T_a=200.0, T_e=0.0))


@pytest.mark.parametrize("lam", [-0.1, 1.5, math.nan])
def test_the_mix_of_models_lies_between_them(lam):
    with pytest.raises(ValueError, match=r"\[0, 1\]"):
        make_puller(lam=lam)
