"""Comparisons: runs are trained once and judged alike, the table's figures are right, a stopped command goes on."""

import csv
import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
pytest.importorskip("matplotlib")

from cz_gym.agents.training import run, validation
from cz_gym.agents.training.recipes import PPO, SAC, Imitation
from cz_gym.evaluation import cluster
from cz_gym.evaluation.protocol import TEST_SEEDS, VALIDATION_SEEDS
from cz_gym.evaluation.statistics import Resamples
from studies.comparison import command, results, table, training
from studies.comparison import figures as figures_of_it
from studies.comparison.results import ACTIVITY, FIGURES, LOST, RMSE, Plan, Result
from studies.comparison.variants import Study, Variant
from tests.small_learners import held, losing

SMALL = {"num_envs": 4, "hidden": (4,), "steps": 128}
BASE = Variant(PPO(**SMALL, n_steps=16, batch_size=64, n_epochs=1), "as it is")
VARIANTS = (
    BASE,
    Variant(SAC(**SMALL, learning_starts=16, buffer_size=64, batch_size=8), "SAC", "ppo"),
    Variant(Imitation(name="few", teacher="lqg", rounds=1, episodes=2, control_interval=60.0), "DAgger", "ppo"),
)
STUDY = Study("some", "Some question", VARIANTS, 128)
CRYSTALS = VALIDATION_SEEDS[2:4]


def figures(rmse: float, activity: float, lost: float = 0.0, crystals: int = 50) -> np.ndarray:
    values = np.zeros((crystals, len(FIGURES)))
    values[:, FIGURES.index(RMSE)], values[:, FIGURES.index(ACTIVITY)] = rmse, activity
    values[:, FIGURES.index(LOST)] = np.arange(crystals) < lost * crystals
    return values


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "PICKING", VALIDATION_SEEDS[:2])
    monkeypatch.setattr(validation, "JUDGING", CRYSTALS)


def test_what_judges_neither_selects_nor_tests() -> None:
    judged = set(validation.JUDGING)
    assert judged <= set(VALIDATION_SEEDS)
    assert not judged & (set(validation.PICKING) | set(TEST_SEEDS))


@pytest.mark.usefixtures("small")
def test_a_comparison_keeps_what_is_finished_and_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out, learn = tmp_path / "out", run.Run.learn
    options = ["--seeds", "1", "--steps", "128", "--jobs", "1", "--out", str(out), "--work", str(tmp_path / "work")]
    trained: list[str] = []

    def counted(self: run.Run, *arguments: Any) -> None:
        trained.append(self.recipe.name)
        learn(self, *arguments)
        if len(trained) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(run.Run, "learn", counted)
    assert command.main(STUDY, options) == 130
    (first,) = (out / "runs").iterdir()
    before = first.read_bytes()
    assert command.main(STUDY, options) == 0
    assert trained == ["ppo", "sac", "sac", "few"]
    assert first.read_bytes() == before
    told = json.loads(before)
    assert told["key"]["settings"]["recipe"]["num_envs"] == 4
    assert {"command", "git_commit", "packages"} <= set(told["provenance"])
    assert [len(told["figures"][name]) for name in FIGURES] == [len(CRYSTALS)] * len(FIGURES)
    assert {path.name for path in out.iterdir()} == {"table.csv", "table.md", "forest.png", "curves.png", "runs"}
    left = {path.name for folder in (tmp_path / "work").iterdir() for path in folder.glob("*.*")}
    assert {"agent.onnx", "agent.json", "summary.json", "progress.csv"} <= left, "agents stay"
    assert "checkpoint.safetensors" not in left
    text = (out / "table.md").read_text()
    for name in ("**few** | 1", "less ppo |", "- **sac**: SAC"):
        assert name in text
    assert (out / "curves.png").read_bytes().startswith(b"\x89PNG")
    capsys.readouterr()
    assert command.main(STUDY, [*options, "--list"]) == 0
    assert capsys.readouterr().out.count("1/1") == 3
    assert command.main(STUDY, [*options, "--list", "--rows", "few,sac", "--steps", "64"]) == 0
    listed = capsys.readouterr().out.splitlines()
    assert [line.split()[:2] for line in listed] == [["sac", "0/1"], ["few", "1/1"]], "--steps are not an imitation's"
    assert command.main(STUDY, options) == 0
    assert len(trained) == 4


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.usefixtures("small")
def test_a_lost_node_loses_nothing(nodes: tuple[Any, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    there, here = tmp_path / "there", tmp_path / "here"
    completed, watch = cluster.completed, losing(nodes, there / "work")
    monkeypatch.setattr(cluster, "completed", lambda function, tasks: completed(partial(held, function), tasks, watch))
    for folder, how in ((there, ["--ray"]), (here, ["--jobs", "1"])):
        folders = ["--out", str(folder / "out"), "--work", str(folder / "work")]
        assert command.main(STUDY, ["--rows", "few", "--seeds", "3", *folders, *how]) == 0
    every = [json.loads(path.read_text())["sessions"] for path in (there / "work").glob("*/settings.json")]
    assert sorted(map(len, every)) == [1, 1, 2], "one run was resumed, none done twice"
    assert (there / "out/table.csv").read_text() == (here / "out/table.csv").read_text()
    assert "few,ppo,0 1 2,2,rmse_mm" in (here / "out/table.csv").read_text()


def test_a_result_is_of_everything_it_depends_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = Plan(tmp_path, tmp_path, CRYSTALS)
    other = replace(BASE, recipe=replace(BASE.recipe, memory=30.0))

    def place(plan: Plan, variant: Variant = BASE, seed: int = 0) -> Path:
        return results.path_of(plan, *training._identity(variant.recipe, seed))

    paths = [place(plan), place(plan, seed=1), place(plan, other)]
    paths.append(place(plan._replace(crystals=VALIDATION_SEEDS[:2])))
    with monkeypatch.context() as patch:
        patch.setattr(results, "SCENARIO", "puller")
        paths.append(place(plan))
    with monkeypatch.context() as patch:
        patch.setattr(results, "_code", lambda: "another learner")
        paths.append(place(plan))
    assert len(set(paths)) == 6
    assert place(plan._replace(work=tmp_path / "elsewhere")) == paths[0]


@pytest.mark.parametrize("content", ["{", "[]", '{"figures": {"rmse_mm": [1, 2]}, "validations": []}'])
def test_a_damaged_result_is_named(content: str, tmp_path: Path) -> None:
    plan = Plan(tmp_path, tmp_path, CRYSTALS)
    path = results.path_of(plan, "lqg", "settings")
    path.parent.mkdir()
    path.write_text(content)
    with pytest.raises(ValueError, match=path.name):
        results.cached(plan, "lqg", "settings", lambda: pytest.fail("it was made again"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--rows", "ppo,sacc"], "unknown row 'sacc': did you mean 'sac'? Choose from ppo, sac, few"),
        (["--seeds", "0"], "--seeds: must be between 1 and 100, not 0"),
        (["--steps", "-5"], "--steps: must be between 1"),
        (["--jobs", "0"], "--jobs: must be between 1 and 64, not 0"),
    ],
)
def test_mistakes_give_one_line(arguments: list[str], message: str, refused: Any) -> None:
    error = refused(partial(command.main, STUDY), arguments)
    assert error.startswith("python -m studies.some: ")
    assert message in error


def finished(random: np.random.Generator, seeds: range, shift: float) -> dict[int, Result]:
    crystals = 1.0 + shift + np.random.default_rng(1).normal(size=(40, 1))
    noise = [0.01 * random.normal(size=(40, len(FIGURES))) for _ in seeds]
    progress = [{"steps": 128.0, "seconds": 60.0, "validation_rmse_mm": 1.0}]
    return {seed: Result(crystals + each, progress) for seed, each in zip(seeds, noise, strict=True)}


def test_curves_stand_beside_the_classical_controllers() -> None:
    runs = {"ppo": finished(np.random.default_rng(0), range(1), 0.0)}
    assert figures_of_it._references(table.tabulate(VARIANTS, runs)) == {}
    runs["ppo"][0] = runs["ppo"][0]._replace(validations=[{"lqg_rmse_mm": 0.06, "validation_rmse_mm": 0.05}])
    assert figures_of_it._references(table.tabulate(VARIANTS, runs)) == {"lqg": 0.06}


def test_differences_are_paired_by_crystal_and_training_seed() -> None:
    random = np.random.default_rng(0)
    runs = {"ppo": finished(random, range(3), 0.0), "sac": finished(random, range(2), 0.1)}
    base, other = table.tabulate(VARIANTS, runs)
    assert base.cells[RMSE].difference is None
    values, reference = (np.array([runs[name][seed].figures[:, 0] for seed in range(2)]) for name in ("sac", "ppo"))
    cell = other.cells[RMSE]
    assert cell.mean.mean == pytest.approx(values.mean())
    assert cell.difference.mean == pytest.approx((values - reference).mean())
    draws = Resamples.draw(40)
    by_hand = [
        sum(seeds[i] * (crystals @ (values - reference)[i]) for i in range(2))
        for seeds, crystals in zip(draws.training_seeds(2), draws.episodes, strict=True)
    ]
    np.testing.assert_allclose(cell.difference.ci95, np.quantile(by_hand, [0.025, 0.975]))
    # The crystals' own spread, fifty times the difference's, has gone.
    assert cell.difference.ci95[1] - cell.difference.ci95[0] < 0.02 < cell.mean.ci95[1] - cell.mean.ci95[0]
    rows = list(csv.reader(table.to_csv([base, other]).splitlines()))
    assert len(rows) == 1 + 2 * len(FIGURES)
    assert {len(row) for row in rows} == {11}
    assert float(rows[-len(FIGURES)][8]) == pytest.approx(cell.difference.mean, rel=1e-5)
