"""The study of SAC's critics: its cosine against known slopes; bad changes are one line before the training."""

import numpy as np
import pytest

from cz_gym import CzVectorEnv
from studies.critic import FUTURES, ceilings, cells, changed, cosines, main, with_noise_of


def test_the_cosine_is_that_of_the_usual_crystals():
    rng = np.random.default_rng(0)
    true = rng.standard_normal((1000, 2))
    np.testing.assert_allclose(cosines(true, true * [2.0, -0.5]), [1.0, -1.0])
    assert (abs(cosines(true, rng.standard_normal((1000, 2)))) < 0.1).all()
    lost = np.array([[1e6, -1e6]])  # a crystal that is nearly lost
    np.testing.assert_allclose(cosines(np.vstack([true, lost]), np.vstack([true, -lost])), 1.0)


def test_the_ceiling_is_the_cosine_of_a_perfect_critic():
    """Noise of each future three times as large as the slopes: reliability 8 / (8 + 9); without tails a little less."""
    rng = np.random.default_rng(1)
    expected = rng.standard_normal((20_000, 2))
    futures = expected + 3.0 * rng.standard_normal((FUTURES, *expected.shape))
    perfect = cosines(futures.mean(0), expected)
    np.testing.assert_allclose(perfect, np.sqrt(8.0 / 17.0), atol=0.03)
    np.testing.assert_allclose(ceilings(futures), perfect, atol=0.03)
    assert [float(each) for each in cells(futures, expected)[1::2]] == pytest.approx(
        [np.sqrt(8.0 / 17.0)] * 2, abs=0.03
    )


def test_another_future_has_other_noise_and_the_same_crystal():
    env = CzVectorEnv(3, info="all")
    env.reset(seed=[5, 6, 7])
    states, seen = env.get_state(), []
    for shift in (0, 1, 3):
        env.set_state(with_noise_of(states, shift))
        begin = env.get_state()
        seen.append(env.step(np.zeros((3, 2), np.float32))[0])
        np.testing.assert_array_equal([each.slot.slot["x"] for each in begin], [each.slot.slot["x"] for each in states])
    assert (seen[0] != seen[1]).any(axis=1).all()
    np.testing.assert_array_equal(seen[0], seen[2])


def test_an_agent_that_loses_every_crystal_has_no_cosine():
    assert np.isnan(cosines(np.empty((0, 2)), np.empty((0, 2)))).all()
    assert cells(np.empty((FUTURES, 0, 2)), np.empty((0, 2))) == ["nan [nan, nan]", "nan"] * 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("stepz=3", "'stepz=3' is no FIELD=NUMBER; fields: action_repeat, "),
        ("steps=nan", "steps='nan': not a number that it can be"),
        ("steps=1e9999", "steps='1e9999': not a number that it can be"),
        ("name=3", "'name=3' is no FIELD=NUMBER"),
    ],
)
def test_a_change_that_the_recipe_does_not_have_is_refused(change, message, capsys):
    assert main([change]) == 2
    assert message in capsys.readouterr().err


def test_a_change_keeps_the_kind_of_its_field():
    recipe = changed(["steps=5e6", "target_entropy=1"])
    assert (recipe.steps, recipe.num_envs, recipe.target_entropy) == (5_000_000, 312, 1.0)
    assert isinstance(recipe.steps, int)
