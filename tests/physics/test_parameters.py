import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cz_gym import Parameters, make_puller
from cz_gym.physics.parameters import check_parameters


@given(
    st.sampled_from(Parameters._fields),
    st.sampled_from([math.nan, math.inf, -math.inf, -1.0, "0.1", None]),
)
def test_what_is_not_a_number_is_refused_by_name(name: str, value: object) -> None:
    with pytest.raises(ValueError, match=rf"^parameter {name} = .*\[") as refusal:
        check_parameters(Parameters()._replace(**{name: value}))
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"alpha_0": 11.0}, "is it in degrees"),
        ({"v_0": 1.2}, "is it in mm/min"),
        ({"sigma": 0.0}, "parameter sigma"),
        ({"r_0": 0.3}, "crucible"),
        ({"T_e": 4000.0}, "no finite operating point"),
    ],
)
def test_what_no_puller_can_be_made_of_is_refused(given: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_puller(Parameters(**given))
    assert check_parameters(Parameters(alpha_0=0.0, T_a=0.0, T_e=0.0))


@pytest.mark.parametrize("lam", [-0.1, 1.5, math.nan])
def test_the_mix_of_models_lies_between_them(lam: float) -> None:
    with pytest.raises(ValueError, match=r"\[0, 1\]"):
        make_puller(lam=lam)
