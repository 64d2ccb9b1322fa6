"""The search: begins with the recipe, keeps what it tried, gives up the hopeless, says whether anything was found."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cz_gym.agents.training import recipes as settings
from cz_gym.agents.training import run
from cz_gym.agents.training.validation import PICKING
from cz_gym.evaluation.protocol import TEST_SEEDS, VALIDATION_SEEDS
from studies.search import __main__ as search
from studies.search import report as search_report
from studies.search import trial as search_trial
from studies.search.space import KNOBS, Trial, read_history, settings_of, values_of, write_history
from studies.search.trial import CHOOSE, CONFIRM, Given, Tried

SHIPPED = values_of(settings.PPO())


def test_the_knobs_turn_what_they_say() -> None:
    shipped = settings.PPO()
    again = settings_of(SHIPPED, shipped.steps)
    assert again.gamma == pytest.approx(shipped.gamma)
    assert asdict(again) | {"gamma": shipped.gamma} == asdict(shipped)
    for number, knob in enumerate(KNOBS):
        assert knob.low <= SHIPPED[number] <= knob.high
        turned = tuple(knob.low if place == number else value for place, value in enumerate(SHIPPED))
        other = settings_of(turned, shipped.steps)
        assert values_of(other)[number] == pytest.approx(knob.low, rel=1e-3)
        apart = {name for name, value in asdict(other).items() if value != asdict(again)[name]}
        assert len(apart) == 1


def test_crystals_that_select_choose_and_confirm_are_others() -> None:
    looked, tested = set(PICKING), set(TEST_SEEDS)
    assert set(CHOOSE) | set(CONFIRM) <= set(VALIDATION_SEEDS)
    assert not set(CHOOSE) & set(CONFIRM)
    assert not (set(CHOOSE) | set(CONFIRM)) & (looked | tested)


def bowl(choice: settings.PPO) -> float:
    """A cost that is least where the actor's pace is 0.05 and the noise is small."""
    return 0.01 * (np.log(choice.actor_pace / 0.05) ** 2 + choice.noise[0])


@pytest.fixture
def simple(monkeypatch: pytest.MonkeyPatch) -> list[settings.PPO]:
    """Trials that take no time."""
    made: list[settings.PPO] = []

    def attempt(choice: settings.PPO, seed: int, judged: Any, work: Path, tell: Any = lambda look, cost: None) -> Tried:
        made.append(choice)
        for look in range(1, 4):
            tell(look, bowl(choice) * look / 3)
        noise = np.random.default_rng([seed, 1]).normal(scale=1e-5, size=(len(judged), 2))
        return Tried(bowl(choice) + noise, 0.0 * noise, (bowl(choice),), 1.0)

    monkeypatch.setattr(search_trial, "attempt", attempt)
    monkeypatch.setattr(search_report, "attempt", attempt)
    return made


def command(folder: Path, trials: int) -> list[str]:
    return ["--trials", str(trials), "--out", str(folder / "out"), "--work", str(folder / "work")]


def test_a_search_begins_with_the_recipe_and_goes_on(
    simple: list[settings.PPO], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert search.main([*command(tmp_path, 12), "--finalists", "0"]) == 0
    path = tmp_path / "out" / "history.csv"
    first = path.read_text().splitlines()
    assert len(first) == 13
    np.testing.assert_allclose(read_history(path, 600_000)[0].values, SHIPPED, rtol=1e-3)
    assert search.main(command(tmp_path, 30)) == 0
    assert path.read_text().splitlines()[:13] == first
    trials = read_history(path, 600_000)
    assert len(trials) == 30
    assert any(trial.pruned for trial in trials)
    assert min(trial.cost for trial in trials) < 0.5 * trials[0].cost
    assert "better than the recipe: trial" in (tmp_path / "out" / "report.md").read_text()
    times = len(simple)
    assert search.main(command(tmp_path, 30)) == 0
    assert len(simple) == times
    assert search.main([*command(tmp_path, 30), "--steps", "7"]) == 2
    assert "holds trials of --steps 600000, not 7" in capsys.readouterr().err


def test_a_search_without_a_find_says_so() -> None:
    noise = np.random.default_rng(0).normal(scale=1e-3, size=(2, 3, 50, 2))
    text = search_report.report([], {0: noise[0], 4: noise[1]}, 1000)
    assert "None is better than the recipe beyond this noise." in text
    assert "trial 4" in search_report.report([], {0: noise[0], 4: noise[0] - 1e-4}, 1000)


def test_an_interrupted_search_keeps_its_trials(
    simple: list[settings.PPO], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(*args: Any) -> Tried:
        raise KeyboardInterrupt

    assert search.main([*command(tmp_path, 2), "--finalists", "0"]) == 0
    monkeypatch.setattr(search_trial, "attempt", stop)
    assert search.main(command(tmp_path, 5)) == 130
    assert "goes on from the trials" in capsys.readouterr().err
    assert len(read_history(tmp_path / "out" / "history.csv", 600_000)) == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--trials", "0"], "--trials must be between 1 and 10000, not 0"),
        (["--finalists", "-1"], "--finalists must be between 0"),
        (["--seeds", "0"], "--seeds must be between 1"),
    ],
)
def test_mistakes_give_one_line(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert search.main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("content", ["a,b\n1,2\n", "half"])
def test_another_history_is_refused(content: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "out").mkdir()
    path = tmp_path / "out" / "history.csv"
    write_history(path, [Trial(SHIPPED, False, 0.0, 0.0, 1.0, (0.1, 0.2), 600_000)])
    assert read_history(path, 600_000)[0].course == (0.1, 0.2)
    path.write_text(path.read_text()[:-20] + "\n" if content == "half" else content)
    assert search.main(command(tmp_path, 1)) == 2
    error = capsys.readouterr().err
    assert "history.csv" in error
    assert error.count("\n") == 1


def test_a_trial_learns_from_the_kept_imitation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "PICKING", VALIDATION_SEEDS[:2])
    recipe = settings.Recipe(num_envs=16, hidden=(8, 8), clone=settings.Clone("lqg", rounds=1, episodes=2, epochs=1))
    quick = settings.PPO(recipe=recipe, n_steps=16, batch_size=256, n_epochs=1, critic_steps=0, steps=512)
    looks: list[int] = []
    found = search_trial.attempt(quick, 0, VALIDATION_SEEDS[2:5], tmp_path, lambda look, cost: looks.append(look))
    assert found.last.shape == found.start.shape == (3, 2)
    assert looks == list(range(1, len(found.course) + 1))
    assert len(looks) >= 2

    def give_up(look: int, cost: float) -> None:
        raise Given

    with pytest.raises(Given):
        search_trial.attempt(quick, 0, VALIDATION_SEEDS[2:5], tmp_path, give_up)
    assert [path.name for path in tmp_path.iterdir()] == ["imitations"]
