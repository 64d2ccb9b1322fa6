"""Checkpoints: what goes on is what was saved, and what does not belong is refused."""

import io
import math
import zipfile
from dataclasses import replace

import pytest
import torch

from cz_gym.agents import AgentFileError
from cz_gym.agents.recipes import make_algorithm
from cz_gym.agents.train import load_checkpoint, restore, to_bytes
from tests.small_learners import SMALL, SMALL_APG, SMALL_SAC, learned, trained


def resume(learner, other, path):
    """Have another algorithm go on from a checkpoint of the first; what the checkpoint says of the run."""
    path.write_bytes(to_bytes(learner, 12.0, 0.5))
    progress, state, _ = load_checkpoint(path)
    restore(other, progress, state, path)
    return progress


def test_a_checkpoint_continues_and_refuses_what_does_not_fit(ppo, tmp_path):
    path, files = tmp_path / "checkpoint.zip", {"agent.onnx": b"network"}
    other = make_algorithm(SMALL, 1, 128)
    progress = resume(ppo, other, path)
    assert progress[:3] == (128, 12.0, 0.5), "not environment steps"
    assert progress.returns[2] > 60, "returns that rewards are normalised with"
    again = to_bytes(other, 12.0, 0.5, files)
    path.write_bytes(again)
    assert load_checkpoint(path)[::2] == (progress, files)
    with zipfile.ZipFile(path) as one, zipfile.ZipFile(io.BytesIO(to_bytes(ppo, 12.0, 0.5))) as two:
        assert {name: one.read(name) for name in two.namelist()} == {name: two.read(name) for name in two.namelist()}
    with pytest.raises(AgentFileError, match="does not fit"):
        restore(make_algorithm(replace(SMALL, hidden=(8, 8)), 0), *load_checkpoint(path)[:2], path)
    path.write_bytes(again[:-100])
    with pytest.raises(AgentFileError, match="not a checkpoint of this release, or damaged"):
        load_checkpoint(path)


def test_weights_that_are_not_finite_are_not_saved():
    learner = make_algorithm(SMALL, 0)
    with torch.no_grad():
        next(learner.policy.parameters()).fill_(math.nan)
    with pytest.raises(AgentFileError, match="went wrong: a weight is not finite; the last checkpoint stays"):
        to_bytes(learner, 1.0, None)


@pytest.mark.parametrize("recipe", [SMALL, SMALL_APG], ids=lambda recipe: recipe.name)
def test_an_algorithm_restored_before_its_first_update_learns_as_the_one_it_came_from(recipe, tmp_path):
    first, second, unsaved = (make_algorithm(recipe, 0) for _ in range(3))
    resume(first, second, tmp_path / "checkpoint.zip")
    for algorithm in (first, second, unsaved):
        algorithm.set_random_seed(3)
        learned(algorithm, recipe)
    parameters = [torch.cat([each.flatten() for each in one.policy.parameters()]) for one in (first, second, unsaved)]
    assert all(torch.equal(each, parameters[0]) for each in parameters)


def test_a_resumed_sac_keeps_its_temperature(tmp_path):
    """stable-baselines3 counts it as a variable, not among the parameters."""
    learner, other = make_algorithm(SMALL_SAC, 0), make_algorithm(SMALL_SAC, 1)
    with torch.no_grad():
        learner.log_ent_coef.fill_(-1.25)
    resume(learner, other, tmp_path / "checkpoint.zip")
    assert other.log_ent_coef.item() == -1.25
    assert other.log_ent_coef in other.ent_coef_optimizer.param_groups[0]["params"]


def test_a_resumed_sac_fills_a_new_replay_buffer_before_it_learns(tmp_path):
    other = make_algorithm(SMALL_SAC, 0, 256)
    assert resume(trained(SMALL_SAC), other, tmp_path / "checkpoint.zip").steps == 256
    learned(other, replace(SMALL_SAC, steps=256 + 4 * 32))
    assert (other.replay_buffer.size() * 4, other._n_updates) == (32, 0)
    learned(other, replace(SMALL_SAC, steps=256 + 4 * 36))
    assert other._n_updates == 1
