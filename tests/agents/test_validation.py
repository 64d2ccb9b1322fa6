"""Validation: classical controllers beside a learner are designed for each crystal's scenario, as in the benchmark."""

from dataclasses import replace

import numpy as np
import pytest

from cz_gym import CzEnv
from cz_gym.agents import validation
from cz_gym.agents.recipes import PPO
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.protocol import TEST_SEEDS, VALIDATION_SEEDS
from cz_gym.evaluation.rollout import rollout
from cz_gym.tools.registry import make_controller

SEEDS = range(1_000_000, 1_000_006)


def test_crystals_that_judge_neither_select_nor_test():
    judged = set(validation.JUDGING_SEEDS)
    assert judged <= set(VALIDATION_SEEDS)
    assert not judged & (set(validation.SELECTION_SEEDS) | set(TEST_SEEDS))


@pytest.mark.parametrize("scenario", ["randomized", "randomized=0.4,hard=0.2,puller=0.4"])
def test_a_reference_has_its_design_for_each_crystal(scenario, monkeypatch):
    monkeypatch.setattr(validation, "SELECTION_SEEDS", SEEDS)
    monkeypatch.setattr(validation, "JUDGING_SEEDS", SEEDS[:1])
    monkeypatch.setattr(validation, "REFERENCES", {"Cz-v0": ("paper-tuned",)})
    recipe = replace(PPO(), scenario=scenario)
    config = replace(recipe.config, observation="measured", action="direct")
    errors, drawn = [], set()
    for seed in SEEDS:
        env = CzEnv.from_config(config)
        name = env.reset(seed=seed)[1].get("scenario", "randomized")
        own = config.with_scenario(name)
        errors.append(metrics(rollout(make_controller("paper-tuned", own), own, [seed])).rmse_mm[0])
        drawn.add(name)
    found = validation.references(make_controller, recipe)
    assert found == {"paper-tuned": pytest.approx((np.mean(errors), errors[0]), rel=1e-12)}
    assert len(drawn) == (1 if scenario == "randomized" else 3)
