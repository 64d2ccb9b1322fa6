"""Robustness that is measured: the search on a grid and the altered policy."""

import numpy as np

from cz_gym.evaluation.rollout import rollout
from studies import robustness


def test_robustness_is_the_largest_change_that_a_bisection_finds():
    assert [robustness.largest((1.0, 2.0, 3.0, 4.0), lambda x, end=end: x <= end) for end in (0.5, 1.0, 3.5, 9.0)] == [
        None, 1.0, 3.0, 4.0,
    ]  # fmt: skip


def test_an_altered_policy_scales_the_pull_and_holds_its_actions_back():
    policy, config = robustness.policy_and_config("paper-tuned", "randomized", 0.1)
    plain, same = (rollout(each, config, [1, 2]) for each in (policy, robustness.Altered(policy)))
    np.testing.assert_array_equal(plain.signals.v_p, same.signals.v_p)
    late = rollout(robustness.Altered(policy, factor=2.0, late=3), config, [1, 2]).signals
    v_0 = config.parameters.v_0
    np.testing.assert_array_equal(late.v_p[:3], v_0)
    np.testing.assert_allclose(late.v_p[3] - v_0, 2.0 * (plain.signals.v_p[0] - v_0), rtol=1e-5)
