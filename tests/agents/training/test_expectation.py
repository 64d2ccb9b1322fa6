"""What stands in for a reading that fails: it is found by a regression, once, and a resumed run does not lose it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("stable_baselines3")

from stable_baselines3.common.logger import Logger

from cz_gym.agents.training import filter_bank
from cz_gym.agents.training.checkpoint import load_checkpoint, restore, to_bytes
from cz_gym.agents.training.expectation import Expectation
from cz_gym.agents.training.filter_bank import STATE, FilterBank
from cz_gym.agents.training.gradient import GradientLearner
from cz_gym.agents.training.recipes import RECIPES
from cz_gym.observation import MEASURED

VALID = [channel.name for channel in MEASURED].index("valid")


def test_a_reading_that_fails_is_replaced_by_what_is_to_be_expected() -> None:
    """The regression finds a linear law of means and other readings, takes no failed reading for one, and changes
    nothing where nothing was seen. What fails, the network then reads as that law has it."""
    random, network, expectation = np.random.default_rng(0), FilterBank(5.0, ()), Expectation()
    expectation.teach(network)
    assert torch.equal(network.expected, FilterBank(5.0, ()).expected)
    law = random.normal(size=(filter_bank.REMEMBERED, 1))
    law[[filter_bank.MEANS, filter_bank.MEANS + VALID]] = 0.0
    memory = torch.from_numpy(random.normal(size=(4000, STATE))).float()
    seen = torch.from_numpy(random.normal(size=(4000, len(MEASURED)))).float()
    seen[:, VALID] = torch.from_numpy(random.random(4000) < 0.5).float()
    wanted = torch.cat([memory[:, : filter_bank.MEANS], seen], dim=1) @ torch.from_numpy(law).float()
    readings = seen.clone()
    readings[:, :1] = torch.where(seen[:, VALID : VALID + 1] > 0.5, wanted, torch.tensor(99.0))
    expectation.see(memory, readings)
    expectation.teach(network)
    np.testing.assert_allclose(network.expected, law, atol=1e-3)
    failed, whole = readings[readings[:, VALID] < 0.5], readings[readings[:, VALID] < 0.5].clone()
    whole[:, 0] = wanted[readings[:, VALID] < 0.5, 0]
    before = memory[readings[:, VALID] < 0.5]
    with torch.no_grad():
        after, as_expected = (network.remember(each, before)[1] for each in (failed, whole))
    means = slice(0, len(filter_bank.TIMES))
    np.testing.assert_allclose(after[:, means], as_expected[:, means], atol=5e-3)


class Stopped(Exception):
    """Ends a run."""


@pytest.mark.parametrize("stop", [1, 2, 3, 4])
def test_what_a_warm_up_gathers_is_not_lost_where_a_run_is_resumed(stop: int, tmp_path: Path) -> None:
    """A warm-up of three updates ends in one expectation, and one whitening, wherever the run was stopped."""
    recipe: Any = replace(RECIPES["gradient"], start="", num_envs=8, window=24, steps=8 * 24 * 60)
    path, per_update = tmp_path / "checkpoint.safetensors", 8 * 24
    first, other = (
        GradientLearner(recipe, 0, recipe.config, Logger(None, []), done * per_update) for done in (0, stop)
    )

    def watch(learner: GradientLearner, until: int) -> None:
        def stopped(steps: int, doing: str) -> None:
            if steps >= until * per_update:
                path.write_bytes(to_bytes(learner, 1.0, None))
                raise Stopped

        with pytest.raises(Stopped):
            learner.learn(stopped)

    plain = first.network.expected.clone()
    watch(first, stop)
    restore(other, load_checkpoint(path)[1], path)
    before, whitened = other.network.expected.clone(), other.whitened[0][1].scaling.clone()
    assert torch.equal(before, plain) == (stop < 4)
    watch(other, 6)
    assert torch.equal(other.network.expected, before) == (stop == 4)
    assert torch.equal(other.whitened[0][1].scaling, whitened) == (stop == 4)
    assert bool(other.network.expected.isfinite().all())
    assert not other.expectation.seen
    assert not other.products.any()
