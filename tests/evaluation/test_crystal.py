"""The figure of one crystal: who is shown when there are many, and a crystal that nothing disturbs."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from cz_gym.config import make_config
from cz_gym.evaluation.metrics import metric_names
from cz_gym.evaluation.protocol import find_row
from cz_gym.evaluation.report.crystal import COLUMNS, chosen, heading
from cz_gym.evaluation.report.figures import draw_figures
from cz_gym.evaluation.results import Benchmark, Controller, Sample, summarise
from cz_gym.evaluation.rollout import rollout


class Still:
    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Any:
        return np.zeros((len(observation), 2), np.float32), state


def sample(name: str, rmse: float, observation: str = "measured", seeds: tuple[int, ...] = ()) -> Sample:
    values = np.full((1, 1, len(metric_names())), rmse)
    return Sample(Controller(name, observation, "", seeds), (7,), values, 0.0, cast(Any, None), 5.0)


def test_many_controllers_are_chosen_by_a_rule_and_the_rest_named() -> None:
    many = [sample("bound", 0.1, "state"), sample("paper", 9.0), *(sample(f"c{i}", 1.0 + i) for i in range(6))]
    many.append(sample("ppo", 99.0, seeds=(0,)))
    shown = chosen(many)
    assert len(shown) == COLUMNS
    assert [one.controller.name for one in shown] == ["paper", "c0", "c1", "c2", "c3", "ppo"]
    assert chosen(many[::-1]) == shown[::-1]
    outcomes = [SimpleNamespace(controller=one.controller) for one in many]
    text = heading(cast(Any, SimpleNamespace(row=find_row("hard"), outcomes=outcomes)), shown)
    assert text.endswith("not shown: bound, c4, c5")
    two = [one for one in many if one.controller.name in ("bound", "ppo")]
    assert "\n" not in heading(cast(Any, SimpleNamespace(row=find_row("hard"), outcomes=outcomes[::8])), two)


def test_many_agents_leave_room_for_what_they_are_compared_with() -> None:
    agents = [sample(f"ppo-{i}", 9.0 - i, seeds=(0,)) for i in range(6)]
    others = [sample("paper", 99.0), sample("lqg", 1.0), sample("pid", 2.0)]
    shown = [one.controller.name for one in chosen([*others, *agents])]
    assert shown == ["paper", "lqg", "pid", "ppo-3", "ppo-4", "ppo-5"]


def test_figures_of_a_crystal_that_nothing_disturbs_and_of_a_name_that_seems_a_formula() -> None:
    results = []
    for name in ("nominal", "randomized"):
        row = find_row(name)
        run = rollout(Still(), make_config(name, horizon=600.0), row.seeds(2))
        results.append(summarise(row, [Sample.of(Controller("a $\\frac$ b", "measured", "", (1,)), [run])]))
    figures = draw_figures(Benchmark(tuple(results), "", ()))
    assert set(figures) == {"crystal.png", "errors.png", "pareto.png"}
    assert all(image.startswith(b"\x89PNG") for image in figures.values())
