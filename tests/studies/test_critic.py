"""The study of SAC's critics: its cosine against known slopes; bad changes are one line before the training."""

import numpy as np
import pytest

from studies.critic import changed, cosines, main


def test_the_cosine_is_that_of_the_usual_crystals():
    rng = np.random.default_rng(0)
    true = rng.standard_normal((1000, 2))
    np.testing.assert_allclose(cosines(true, true * [2.0, -0.5]), [1.0, -1.0])
    assert (abs(cosines(true, rng.standard_normal((1000, 2)))) < 0.1).all()
    lost = np.array([[1e6, -1e6]])  # a crystal that is nearly lost
    np.testing.assert_allclose(cosines(np.vstack([true, lost]), np.vstack([true, -lost])), 1.0)


def test_an_agent_that_loses_every_crystal_has_no_cosine():
    assert np.isnan(cosines(np.empty((0, 2)), np.empty((0, 2)))).all()


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
    assert (recipe.steps, recipe.target_entropy) == (5_000_000, 1.0)
    assert isinstance(recipe.steps, int)
