"""Training: recipes, validation, what runs leave, that they go on where they stopped, and mistakes in one line."""

import csv
import io
import itertools
import json
import math
import os
import signal
import sys
from dataclasses import asdict, replace
from functools import cache
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise, VectorizedActionNoise
from stable_baselines3.common.utils import set_random_seed
from tqdm import tqdm

from cz_gym import CzEnv
from cz_gym.agents import AgentFileError, OnnxPolicy, load, recipes
from cz_gym.agents import train as training
from cz_gym.agents.asymmetric import LearnState
from cz_gym.agents.callbacks import AverageWeights, ClipAdvantages, ClipErrors, NormalNoise
from cz_gym.agents.recipes import CRYSTAL_RECIPES, MANY_STEPS, PPO, RECIPES, PPOResidual, make_algorithm
from cz_gym.agents.train import CHECKPOINT, TrainingRun, load_checkpoint, restore, to_bytes
from cz_gym.config import make_config
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.protocol import TEST_SEEDS, VALIDATION_SEEDS
from cz_gym.evaluation.rollout import rollout
from cz_gym.sb3 import LONG, CzVecEnv
from cz_gym.support.command_line import interpreter
from cz_gym.tools import train
from cz_gym.tools.registry import make_base, make_controller
from tests.small_learners import QUICK, REFERENCES, SMALL, SMALL_APG, SMALL_SAC, SmallRun, learned, train_small, trained

measure_references = recipes.references
ALONG = {name: getattr(CRYSTAL_RECIPES["ppo"], name) for name in ("environment", "stages", "scenario")}
SMALL_PPO = replace(QUICK, steps=4096, control_interval=30.0)


def resume(learner, other, path):
    """Have another algorithm go on from a checkpoint of the first, which it returns."""
    path.write_bytes(to_bytes(learner, 12.0, 0.5))
    checkpoint = load_checkpoint(path)
    restore(other, checkpoint, path)
    return checkpoint


def test_a_checkpoint_continues_and_refuses_what_does_not_fit(ppo, tmp_path):
    path, files = tmp_path / CHECKPOINT, {"agent.onnx": b"network\x00\xff"}
    other = make_algorithm(SMALL, 1, 128)
    checkpoint = resume(ppo, other, path)
    assert checkpoint[:3] == (128, 12.0, 0.5), "not environment steps"
    assert checkpoint.returns[2] > 60, "returns that rewards are normalised with"
    again = to_bytes(other, 12.0, 0.5, files)
    path.write_bytes(again)
    assert load_checkpoint(path).files == files
    assert load_checkpoint(path)[:4] == checkpoint[:4]
    for name, state in checkpoint.parameters.items():
        torch.testing.assert_close(load_checkpoint(path).parameters[name], state, rtol=0.0, atol=0.0)
    with pytest.raises(AgentFileError, match="does not fit"):
        restore(make_algorithm(replace(SMALL, hidden=(8, 8)), 0), checkpoint, path)
    for damaged in (again[:-100], to_bytes(other, 12.0, 0.5, {"../agent.onnx": b""})):
        path.write_bytes(damaged)
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
    resume(first, second, tmp_path / CHECKPOINT)
    for algorithm in (first, second, unsaved):
        algorithm.set_random_seed(3)
        learned(algorithm, recipe)
    parameters = [torch.cat([each.flatten() for each in one.policy.parameters()]) for one in (first, second, unsaved)]
    assert all(torch.equal(each, parameters[0]) for each in parameters)


def test_a_resumed_sac_keeps_its_temperature_and_fills_a_new_replay_buffer_before_it_learns(tmp_path):
    """stable-baselines3 counts the temperature as a variable, not among the parameters."""
    learner, other = trained(SMALL_SAC), make_algorithm(SMALL_SAC, 0, 256)
    with torch.no_grad():
        learner.log_ent_coef.fill_(-1.25)
    assert resume(learner, other, tmp_path / CHECKPOINT).steps == 256
    assert other.log_ent_coef.item() == -1.25
    assert other.log_ent_coef in other.ent_coef_optimizer.param_groups[0]["params"]
    learned(other, replace(SMALL_SAC, steps=256 + 4 * 32))
    assert (other.replay_buffer.size() * 4, other._n_updates) == (32, 0)
    learned(other, replace(SMALL_SAC, steps=256 + 4 * 36))
    assert other._n_updates == 1


@cache
def references_once(make, config):
    """The measured references of an environment, whatever the recipe is."""
    return measure_references(make, SimpleNamespace(config=config))


@pytest.fixture
def quick(monkeypatch, few_crystals):
    monkeypatch.setattr(recipes, "references", lambda make, recipe, _: references_once(make, recipe.config))
    monkeypatch.setitem(RECIPES, "ppo", QUICK)
    monkeypatch.setitem(CRYSTAL_RECIPES, "ppo", replace(QUICK, name="ppo-along", **ALONG))
    for known in (RECIPES, CRYSTAL_RECIPES):
        monkeypatch.setitem(known, "gradient", replace(known["gradient"], num_envs=64, window=12))


def rows(folder):
    return list(csv.DictReader((folder / "progress.csv").read_text().splitlines()))


def content(path):
    return json.loads(path.read_text())


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("algorithm", ["gradient", "ppo"])
def test_a_run_leaves_everything_and_goes_on(algorithm, tmp_path, capsys):
    folder = tmp_path / "run"
    assert train.main(["--algo", algorithm, "--steps", "9000", "--seed", "3", "--out", str(folder), "--plot"]) == 0
    assert f" steps on all, into {folder}\n" in capsys.readouterr().out
    assert (folder / "progress.png").read_bytes().startswith(b"\x89PNG")
    saved = content(folder / "settings.json")
    assert saved["seed"] == 3
    assert saved["settings"]["scenario"] == RECIPES[algorithm].scenario
    assert saved["packages"]["stable-baselines3"]
    assert {"command", "git_commit", "plant_hash", "scenario_hash"} <= set(saved)
    policy = OnnxPolicy.load(folder / "agent.onnx")
    assert policy.contract.training_seed == 3
    summary, before = content(folder / "summary.json"), rows(folder)
    assert policy.contract.validation_cost == summary["validation_cost"]
    assert policy.contract.validation_rmse_mm == summary["validation_rmse_mm"]
    picked_by = {float(row["validation_rmse_mm"]) for row in before}
    assert summary["validation_rmse_mm"] not in picked_by, "judged as it was picked"
    assert list((folder / "tensorboard").rglob("events.*"))
    assert float(before[-1]["paper_rmse_mm"]) > float(before[-1]["lqg_rmse_mm"]) > 0
    assert train.main(["--resume", "--out", str(folder)]) == 0, "nothing was left to learn"
    assert rows(folder) == before
    assert train.main(["--algo", algorithm, "--out", str(folder)]) == 2
    assert "--resume" in capsys.readouterr().err
    assert train.main(["--algo", algorithm, "--steps", "18000", "--seed", "3", "--resume", "--out", str(folder)]) == 0
    after = rows(folder)
    assert after[: len(before)] == before
    assert int(after[-1]["steps"]) >= 18000 > int(before[-1]["steps"])


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("algorithm", CRYSTAL_RECIPES)
def test_a_run_on_whole_crystals_goes_on_and_its_agent_is_for_these(algorithm, tmp_path, capsys):
    folder = tmp_path / "run"
    assert train.main(["--env", "CzCrystal-v0", "--algo", algorithm, "--steps", "6000", "--out", str(folder)]) == 0
    assert "on CzCrystal-v0 (crown, body, tail), 0.5 hard + 0.5 randomized, into" in capsys.readouterr().out
    contract = OnnxPolicy.load(folder / "agent.onnx").contract
    assert (contract.environment, contract.algorithm) == ("CzCrystal-v0", f"{algorithm}-along")
    before = rows(folder)
    assert list(before[-1])[-2:] == ["compensated_rmse_mm", "lqg-along_rmse_mm"]
    assert train.main(["--resume", "--steps", "12000", "--out", str(folder)]) == 0
    assert rows(folder)[: len(before)] == before
    with pytest.raises(AgentFileError, match=r"agent.onnx: trained for CzCrystal-v0, not for Cz-v0: gym.make"):
        load(folder / "agent.onnx", make_config())
    assert train.main(["--env", "Cz-v0", "--resume", "--out", str(folder)]) == 2
    assert f"'{algorithm}-along' is no recipe here" in capsys.readouterr().err


@pytest.fixture
def ctrl_c():
    """Ctrl-C as in a terminal, also where pytest itself runs in the background."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("quick", "ctrl_c")
@pytest.mark.skipif(sys.platform == "win32", reason="signals as POSIX has them")
def test_ctrl_c_in_the_middle_of_an_update_saves_after_it(tmp_path, monkeypatch, capsys):
    """An update is four optimiser steps: two batches in each of two epochs, of which the second is interrupted."""
    clip, calls = torch.nn.utils.clip_grad_norm_, itertools.count(1)

    def interrupted(*arguments):
        if next(calls) == 6:
            os.kill(os.getpid(), signal.SIGINT)
        return clip(*arguments)

    monkeypatch.setitem(RECIPES, "ppo", replace(QUICK, n_epochs=2))
    monkeypatch.setattr("torch.nn.utils.clip_grad_norm_", interrupted)
    folder = tmp_path / "run"
    assert train.main(["--steps", "12000", "--out", str(folder)]) == 130
    assert f"{interpreter()} -m cz_gym train --steps 12000 --out {folder} --resume continues" in capsys.readouterr().err
    checkpoint = load_checkpoint(folder / CHECKPOINT)
    assert 2 * 4096 < checkpoint.steps < 3 * 4096
    moments = checkpoint.parameters["policy.optimizer"]["state"]
    assert {float(each["step"]) for each in moments.values()} == {8.0}
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--seeds", "9-0"], "must be FIRST-LAST"),
        (["--seeds", "0-99999999999"], "at most 1000 seeds"),
        (["--steps", "0"], "between 1 and 1000000000000, not 0"),
        (["--checkpoint-seconds", "nan"], "between 0 and 1000000, not nan"),
        (["--sceanrio", "hard"], "unrecognized arguments"),
        (["--scenario", "quiet"], "unknown scenario 'quiet'"),
        (["--scenario", "hard=much"], "'hard=much' is no scenario with its share"),
        (["--scenario", "none.py:quiet"], "none.py: no such file"),
        (["--resume"], "nothing to resume"),
        (["--set", "learning_rat=1"], "unknown field 'learning_rat': did you mean 'learning_rate'?"),
        (["--set", "n_epochs=few"], "--set n_epochs=few: n_epochs must be a whole number from 1 on, as 2"),
        (["--set", "num_envs=0"], "num_envs must be a whole number from 1 on, as 1024"),
        (["--set", "learning_rate=-1"], "learning_rate must be a number from 0 on, as 0.001"),
        (["--set", "log_std_init=nan"], "log_std_init must be a finite number, as -1.2"),
        (["--set", "gamma=2"], "gamma must be from 0 to 1, as 0.99"),
        (["--algo", "gradient", "--set", "betas=0.9,1"], "betas must be from 0 to 0.9999, as (0.9, 0.9)"),
        (["--set", "told=perhaps"], "told must be true or false, as True"),
        (["--set", "hidden=a,b"], "hidden must be numbers with commas between, as (32, 32)"),
        (["--set", "steps=7"], "unknown field 'steps'"),
        (["--algo", "gradient", "--set", "start=nobody"], "unknown shipped agent 'nobody'"),
        (["--algo", "gradient", "--set", "start=none.onnx"], "none.onnx: no such file"),
        (["--algo", "gradient", "--set", "start=ppo"], "its observation is history, the recipe's is measured"),
        (["--callback", "none.py:Watch"], "none.py: no such file"),
        (["--env", "CzCrystal-v0", "--algo", "sac"], "'sac' is no recipe here: name one of ppo, gradient by --algo"),
    ],
)
def test_a_wrong_command_is_refused_in_one_line(tmp_path, arguments, message, refused):
    assert message in refused(train.main, [*arguments, "--out", str(tmp_path / "run")])
    assert not (tmp_path / "run").exists()


CALLBACK = """
from stable_baselines3.common.callbacks import BaseCallback

class Tracker(BaseCallback):
    def _on_training_end(self):
        with open(__file__ + ".log", "a") as log:
            print(self.model.n_epochs, self.model.policy.net_arch, file=log)

    def _on_step(self):
        return True
"""


@pytest.mark.usefixtures("quick")
def test_fields_of_a_recipe_and_trackers_come_from_the_command(tmp_path):
    """A resumed run keeps its fields."""
    (tmp_path / "own.py").write_text(CALLBACK)
    command = ["--out", str(tmp_path / "run"), "--callback", f"{tmp_path / 'own.py'}:Tracker"]
    chosen = ["--set", "learning_rate=3e-4", "--set", "n_epochs=2", "--set", "hidden=8,8", "--set", "told=no"]
    assert train.main([*command, *chosen, "--steps", "5000"]) == 0
    saved = content(tmp_path / "run" / "settings.json")["settings"]
    assert (saved["learning_rate"], saved["n_epochs"], saved["hidden"], saved["told"]) == (3e-4, 2, [8, 8], False)
    assert OnnxPolicy.load(tmp_path / "run" / "agent.onnx").contract.learned_from == "reward"
    assert train.main([*command, "--resume", "--steps", "10000"]) == 0
    first, second = (tmp_path / "own.py.log").read_text().splitlines()
    for line in (first, second):
        assert line == "2 {'pi': [8, 8], 'vf': [64, 64]}"


def test_ctrl_c_before_anything_was_kept_advises_no_resume(tmp_path, monkeypatch, capsys):
    def interrupted(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(recipes, "references", interrupted)
    assert train.main(["--steps", "12000", "--out", str(tmp_path / "run")]) == 130
    told = capsys.readouterr()
    assert told.err == "cz-gym train: interrupted; nothing was kept yet\n"
    first, last = told.out.splitlines()[-2:]
    assert first.startswith("ppo, seed 0, 12,000 steps on "), "the first word before the references"
    assert last == "measuring paper, paper-tuned, lqg on the validation crystals"


# Training seeds in parallel come out as one by one, and nothing is lost or done twice.


def in_turn(function, tasks, poll_progress, *cluster):
    for number, task in enumerate(tasks):
        yield number, function(task)
        poll_progress()


@pytest.fixture
def seeds(monkeypatch, few_crystals):
    """Small runs in this process; the seeds that were trained, in turn."""
    seeds = []

    def counted(run, bar=None):
        seeds.append(run.seed)
        return train_small(run, bar)

    monkeypatch.setattr(TrainingRun, "train", counted)
    monkeypatch.setattr(training, "run_parallel", in_turn)
    monkeypatch.setattr(recipes, "references", lambda *_: REFERENCES)
    monkeypatch.setitem(RECIPES, "ppo", SMALL_PPO)
    return seeds


def agents(folder):
    return {path.parent.name: path.read_bytes() for path in sorted(folder.glob("*/agent.onnx"))}


def sessions(folder):
    """How often each seed's run was begun or resumed."""
    return [len(content(path)["sessions"]) for path in sorted(folder.glob("*/settings.json"))]


def test_seeds_come_out_as_one_by_one_and_only_once(seeds, tmp_path, capsys):
    several, one = tmp_path / "several", tmp_path / "one"
    assert train.main(["--algo", "ppo", "--seeds", "3-4", "--out", str(several)]) == 0
    assert "seed 4: best agent on 2 validation episodes" in capsys.readouterr().out
    assert train.main(["--algo", "ppo", "--seed", "4", "--out", str(one)]) == 0
    found = agents(several)
    assert list(found) == ["seed3", "seed4"]
    assert found["seed4"] == (one / "agent.onnx").read_bytes() != found["seed3"]
    assert train.main(["--resume", "--seeds", "2-4", "--out", str(several)]) == 0, "the folder knows the recipe"
    assert seeds == [3, 4, 4, 2]
    assert sessions(several) == [1, 1, 1]
    assert train.main(["--seeds", "4-5", "--out", str(several)]) == 2
    assert "seed4 holds a run already" in capsys.readouterr().err
    assert train.main(["--resume", "--seeds", "4-5", "--scenario", "hard", "--out", str(several)]) == 2
    assert "begun with another settings" in capsys.readouterr().err


@pytest.mark.usefixtures("seeds")
def test_no_step_of_training_asks_every_slot(tmp_path, monkeypatch):
    asked, own = [], CzVecEnv.get_attr
    monkeypatch.setattr(CzVecEnv, "get_attr", lambda env, *some: asked.append(some) or own(env, *some))
    assert train.main(["--algo", "ppo", "--out", str(tmp_path / "run")]) == 0
    assert len(asked) < SMALL_PPO.steps // SMALL_PPO.num_envs // SMALL_PPO.action_repeat


def test_an_unfinished_seed_goes_on_and_longer_runs_do_too(seeds, tmp_path, monkeypatch):
    finish = TrainingRun.finish

    def killed(self):
        if self.seed == 1:
            raise AgentFileError("killed")
        return finish(self)

    command = ["--algo", "ppo", "--seeds", "0-1", "--out", str(tmp_path)]
    with monkeypatch.context() as patch:
        patch.setattr(TrainingRun, "finish", killed)
        assert train.main(command) == 2
    assert not (tmp_path / "seed1" / "summary.json").exists()
    assert train.main([*command, "--resume"]) == 0
    assert seeds == [0, 1, 1]
    assert sessions(tmp_path) == [1, 2]
    assert content(tmp_path / "seed1" / "settings.json")["sessions"][1]["from_step"] == 4096
    assert train.main([*command, "--resume", "--steps", "6144"]) == 0
    assert seeds == [0, 1, 1, 0, 1]


@pytest.mark.parametrize("error", [AgentFileError("the training went wrong"), ValueError("could not be broadcast")])
def test_one_seed_that_fails_stops_no_other(error, tmp_path, monkeypatch, seeds, capsys):
    """An error that the project raises on purpose is one line; any other one is raised with its traceback."""

    def failing(run):
        if run.seed == 1:
            raise error
        return train_small(run)

    monkeypatch.setattr(TrainingRun, "train", failing)
    command = ["--algo", "ppo", "--seeds", "0-2", "--out", str(tmp_path)]
    if isinstance(error, AgentFileError):
        assert train.main(command) == 2
        assert capsys.readouterr().err.splitlines()[-1] == "cz-gym train: seed 1: the training went wrong"
    else:
        with pytest.raises(ValueError, match="could not be broadcast") as caught:
            train.main(command)
        notes = "".join(caught.value.__notes__)
        assert "in failing" in notes
        assert "seed 1" in notes
    assert sorted(agents(tmp_path)) == ["seed0", "seed2"]


@pytest.mark.slow
def test_processes_train_the_same(tmp_path, monkeypatch):
    """And the bar counts them all."""
    for place in (tmp_path / "there", tmp_path / "here"):
        runs = [SmallRun(place / f"seed{seed}", SMALL_PPO, seed, REFERENCES) for seed in range(3)]
        with tqdm(total=3, file=io.StringIO()) as bar:
            assert {run.seed for run, _ in training.train_seeds(runs, bar)} == {0, 1, 2}
            assert bar.n == pytest.approx(3)
        monkeypatch.setattr(training, "run_parallel", in_turn)
    assert agents(tmp_path / "there") == agents(tmp_path / "here")


@pytest.mark.parametrize("name", ["ppo", "sac"])
def test_no_two_training_seeds_meet_the_same_crystals(name):
    recipe = replace(RECIPES[name], num_envs=8, hidden=(4,), batch_size=64)
    met = []
    for seed, done in ((0, 0), (1, 0), (2, 0), (1, 327_680)):
        env = make_algorithm(recipe, seed, done).env
        met.append({each.tobytes() for each in env.reset()})
        env.close()
    assert [len(each) for each in met] == [8] * 4
    assert len(set.union(*met)) == 4 * 8


def test_means_over_hours_are_of_the_puller_s_interval():
    recipe = replace(SMALL_PPO, puller="germanium")
    algorithm = make_algorithm(recipe, 0)
    algorithm.learn(recipe.n_steps, LearnState())
    assert algorithm.policy.interval == recipe.config.control_interval == 1.0
    assert algorithm.policy.means.keep[0].item() == pytest.approx(np.exp(-1.0 / LONG[0]))


@pytest.mark.parametrize("name", RECIPES)
def test_the_numbers_of_a_recipe_reach_its_algorithm(name):
    recipe = replace(RECIPES[name], num_envs=64)
    base = make_base(recipe.controller, recipe.config) if isinstance(recipe, PPOResidual) else None
    algorithm = make_algorithm(recipe, 0, 0, base)
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


def test_a_small_budget_of_ppo_keeps_its_exploration_and_its_large_advantages():
    ppo = RECIPES["ppo"]
    few, many = ppo.with_steps(MANY_STEPS - 1), ppo.with_steps(MANY_STEPS)
    assert (few.n_epochs, few.average, few.advantage_quantile) == (5, 0.0, 1.0)
    assert few.log_std_fall == 0.0
    assert replace(many, steps=ppo.steps) == ppo


def test_exploration_falls_by_schedule_unless_it_is_learned():
    """The second of two rollouts has the standard deviation of half way."""
    fading, learning = trained(replace(SMALL, steps=256)), trained(replace(SMALL, learn_std=True))
    half_way = SMALL.log_std_init - 0.5 * SMALL.log_std_fall
    assert fading.policy.log_std.tolist() == pytest.approx([half_way] * 2, abs=1e-6)
    assert learning.policy.log_std.tolist() != pytest.approx([SMALL.log_std_init] * 2, abs=1e-7)
    assert learning.policy.log_std.tolist() == pytest.approx([SMALL.log_std_init] * 2, abs=0.1)


def test_advantages_are_clipped_at_a_quantile_of_their_size():
    learner = make_algorithm(SMALL, 0)
    learner.learn(SMALL.steps // SMALL.action_repeat, LearnState())
    advantages = learner.rollout_buffer.advantages
    mean, before, returns = advantages.mean(), advantages.copy(), learner.rollout_buffer.returns.copy()
    clip = ClipAdvantages(0.75)
    clip.init_callback(learner)
    clip.on_rollout_end()
    most = np.abs(advantages).max()
    assert np.mean(np.abs(advantages) > 0.999 * most) == pytest.approx(0.25, abs=0.05)
    np.testing.assert_allclose(advantages, np.clip(before - mean, -most, most), rtol=1e-5)
    np.testing.assert_array_equal(learner.rollout_buffer.returns, returns)


def test_the_target_of_sac_s_entropy_falls_with_the_steps():
    learner = trained(SMALL_SAC)
    last = SMALL_SAC.num_envs * SMALL_SAC.action_repeat / SMALL_SAC.steps
    assert learner.target_entropy == pytest.approx(SMALL_SAC.target_entropy - (1.0 - last) * SMALL_SAC.entropy_fall)


def test_sac_tries_wider_actions_than_its_policy_s():
    def tried(std):
        recipe = replace(SMALL_SAC, steps=128, action_noise_std=std, learning_starts=0, gradient_steps=0)
        return np.array(trained(recipe).replay_buffer.actions[:8])

    policy, wider = tried(0.0), tried(0.2)
    assert 0.1 < np.std(wider[0] - policy[0]) < 0.4
    assert np.abs(wider).max() <= 1.0


def test_noise_of_all_crystals_in_one_draw_is_the_library_s_own():
    def drawn(noise):
        set_random_seed(3)
        return [noise() for _ in range(2)]

    each = VectorizedActionNoise(NormalActionNoise(np.zeros(2), np.full(2, 0.1)), 5)
    np.testing.assert_array_equal(drawn(NormalNoise(0.1, 5, 2)), drawn(each))


def test_a_critic_s_large_errors_are_clipped_and_the_actor_s_gradient_is_not():
    learner = make_algorithm(SMALL_SAC, 0)
    learner.learn(8, LearnState())
    seen = torch.as_tensor(learner.env.reset())
    actions, targets = torch.zeros(4, 2), torch.tensor([[0.0], [0.1], [-0.2], [5.0]])

    def slopes(actions):
        """Gradients of the critic's last bias and of the actions, of half a mean squared error."""
        (values,) = learner.critic(seen, actions)
        (0.5 * (values - values.detach() + targets).square().mean()).backward()
        bias = learner.critic.q_networks[0][-1].bias
        slope = bias.grad.item()
        learner.critic.zero_grad()
        return slope, actions.grad

    exact, _ = slopes(actions)
    asked = actions.clone().requires_grad_()
    _, exact_actions = slopes(asked)
    clip = ClipErrors(2 / 3)
    clip.init_callback(learner)
    clip.on_training_start({}, {})
    assert exact == pytest.approx(targets.mean().item())
    assert slopes(actions)[0] == pytest.approx((0.0 + 0.1 - 0.2 + 0.2) / 4)
    again = actions.clone().requires_grad_()
    torch.testing.assert_close(slopes(again)[1], exact_actions)
    clip.on_training_end()
    assert slopes(actions)[0] == pytest.approx(exact)


def test_the_kept_agent_has_the_mean_of_the_last_weights_and_learning_goes_on_from_its_own():
    class Log(BaseCallback):
        """Weights of the actor's last layer at each begin of a rollout."""

        weights: ClassVar[list[Any]] = []

        def _on_step(self):
            return True

        def _on_rollout_start(self):
            self.weights.append(self.model.policy.action_net.weight.detach().clone())

    averaged, log = AverageWeights(2.0), Log()
    learner = make_algorithm(replace(SMALL, steps=4 * 128), 0)
    learner.learn(256, [LearnState(), averaged, log])
    expected, *others = log.weights
    for weights in others:
        expected = 0.5 * (expected + weights)
    own = learner.policy.action_net.weight.detach().clone()
    with averaged.applied():
        torch.testing.assert_close(learner.policy.action_net.weight.detach(), expected)
    assert torch.equal(learner.policy.action_net.weight, own)
    assert len(log.weights) > 3


def test_averaging_changes_the_kept_agent_and_not_the_learning(tmp_path):
    found = []
    for share in (0.0, 1.0):
        run = SmallRun(tmp_path / f"{share}", replace(SMALL, steps=4 * 128, average=share), 0, REFERENCES)
        run.train()
        weights = run.algorithm.policy.action_net.weight.detach()
        found.append((weights, OnnxPolicy.load(run.folder / "agent.onnx").content))
    (last, kept), (same, mean) = found
    assert torch.equal(last, same)
    assert kept != mean


SEEDS = range(1_000_000, 1_000_006)


def test_crystals_that_judge_neither_select_nor_test():
    judged = set(recipes.JUDGING_SEEDS)
    assert judged <= set(VALIDATION_SEEDS)
    assert not judged & (set(recipes.SELECTION_SEEDS) | set(TEST_SEEDS))


@pytest.mark.parametrize("scenario", ["randomized", "randomized=0.4,hard=0.2,puller=0.4"])
@pytest.mark.slow
def test_a_reference_has_its_design_for_each_crystal(scenario, monkeypatch):
    monkeypatch.setattr(recipes, "SELECTION_SEEDS", SEEDS)
    monkeypatch.setattr(recipes, "JUDGING_SEEDS", SEEDS[:1])
    monkeypatch.setattr(recipes, "REFERENCES", {"Cz-v0": ("paper-tuned",)})
    recipe = replace(PPO(), scenario=scenario)
    config = replace(recipe.config, observation="measured", action="direct")
    errors, drawn = [], set()
    for seed in SEEDS:
        env = CzEnv.from_config(config)
        name = env.reset(seed=seed)[1].get("scenario", "randomized")
        own = config.with_scenario(name)
        errors.append(metrics(rollout(make_controller("paper-tuned", own), own, [seed])).rmse_mm[0])
        drawn.add(name)
    told: list[int] = []
    found = recipes.references(make_controller, recipe, told.append)
    assert sum(told) == len(SEEDS) + 1
    assert found == {"paper-tuned": pytest.approx((np.mean(errors), errors[0]), rel=1e-12)}
    assert len(drawn) == (1 if scenario == "randomized" else 3)
