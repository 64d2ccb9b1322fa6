import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cz_gym import Parameters, make_puller
from cz_gym.physics.parameters import MACHINE, SIZES, check_parameters

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
