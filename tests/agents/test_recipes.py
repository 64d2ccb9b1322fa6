"""Training seeds learn on crystals of their own, and a resumed run on new ones."""

from dataclasses import asdict, replace

import pytest

from cz_gym.agents.recipes import RECIPES, make_algorithm


@pytest.mark.parametrize("name", ["ppo", "sac"])
def test_no_two_training_seeds_meet_the_same_crystals(name):
    recipe = replace(RECIPES[name], num_envs=8, hidden=(4,), batch_size=64)
    met = []
    for seed, done in ((0, 0), (1, 0), (2, 0), (1, 327_680)):
        env = make_algorithm(recipe, seed, done).env
        met.append({int(each) for each in env.unwrapped._seeds})
        env.close()
    assert [len(each) for each in met] == [8] * 4
    assert len(set.union(*met)) == 4 * 8


@pytest.mark.parametrize("name", RECIPES)
def test_the_numbers_of_a_recipe_reach_its_algorithm(name):
    recipe = replace(RECIPES[name], num_envs=64)
    algorithm = make_algorithm(recipe, 0)
    given = 0
    for field, wanted in asdict(recipe).items():
        found = getattr(algorithm, f"{field}_schedule", getattr(algorithm, field, None))
        if isinstance(wanted, (int, float, tuple)) and found is not None and field != "learning_rate":
            given += 1
            assert (found(1.0) if callable(found) else found) == wanted, field
    assert given >= 1


@pytest.mark.parametrize(("name", "batch"), [("ppo", 174), ("sac", 125)])
def test_a_small_budget_has_fewer_crystals_and_smaller_batches(name, batch):
    recipe, small = RECIPES[name], RECIPES[name].with_steps(2_000_000)
    assert (small.steps, small.batch_size) == (2_000_000, batch)
    assert small.num_envs < recipe.num_envs
    assert small.updates == pytest.approx(recipe.fewest_updates, rel=0.02)
    assert recipe.with_steps(recipe.steps) == recipe
