"""Figures: who is shown when there are many, colours, and a crystal that nothing disturbs."""

import io
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
from PIL import Image

import benchmark
from cz_gym.baselines import OpenLoop
from cz_gym.config import make_config
from cz_gym.evaluation.metrics import metric_names
from cz_gym.evaluation.protocol import find_row
from cz_gym.evaluation.report.canvas import COLOURS, DPI, KNOWN, ORDER, chosen, styles, styles_of
from cz_gym.evaluation.report.crystal import COLUMNS
from cz_gym.evaluation.report.figures import NAMED, draw_figures, named
from cz_gym.evaluation.report.markdown import QUOTED
from cz_gym.evaluation.results import Benchmark, Controller, Sample, summarise
from cz_gym.evaluation.rollout import rollout
from tests.samples import sample_of


def sample(
    name: str, rmse: float, observation: str = "measured", seeds: tuple[int, ...] = (), own: bool = False
) -> Sample:
    values = np.full((1, 1, len(metric_names())), rmse)
    return Sample(Controller(name, observation, "", seeds, own=own), (7,), values, 0.0, cast(Any, None), 5.0)


def names(samples: list[Sample]) -> list[str]:
    return [one.controller.name for one in samples]


def test_many_controllers_are_chosen_by_a_rule() -> None:
    many = [sample("bound", 0.1, "state"), sample("paper", 9.0), *(sample(f"c{i}", 1.0 + i) for i in range(6))]
    many.append(sample("ppo", 99.0, seeds=(0,)))
    shown = chosen(many, 4)
    assert names(shown) == ["paper", "c0", "c1", "ppo"]
    assert chosen(many[::-1], 4) == shown[::-1]
    assert chosen(many, 99) == many


def test_one_s_own_is_shown_beside_the_reference() -> None:
    many = [sample(name, 1.0, seeds=(0,) * (name in ("gradient", "ppo"))) for name in QUOTED]
    many.append(sample("mine", 50.0, own=True))
    assert {"paper", "mine"} < set(names(chosen(many, COLUMNS)))


def test_the_figure_shows_the_controllers_of_readme_s_table() -> None:
    assert set(KNOWN) == set(QUOTED)
    many = [sample(each.name, 0.01) for each in benchmark.classical() if each.default]
    many += [sample(name, 0.001 * len(name), seeds=(0,)) for name in benchmark.SHIPPED]
    assert names(chosen(many, COLUMNS)) == list(QUOTED)


def test_the_best_classical_controller_of_each_scenario_is_named() -> None:
    def scenario(best: str) -> Any:
        many = [sample(f"c{i}", 1.0) for i in range(NAMED)] + [sample("paper", 3.0), sample("lqg-quiet", 2.0)]
        many = [*many, sample("ppo", 0.1, seeds=(0,)), sample("bound", 0.1, "state")]
        means = [0.5 if each.controller.name == best else float(each.values.mean()) for each in many]
        return SimpleNamespace(
            outcomes=[
                SimpleNamespace(sample=each, controller=each.controller, means={"rmse_mm": SimpleNamespace(mean=mean)})
                for each, mean in zip(many, means, strict=True)
            ]
        )

    found = named([scenario("c3"), scenario("lqg-quiet")])
    assert len(found) == len(set(found)) == NAMED
    assert {"paper", "ppo", "c3", "lqg-quiet"} < set(found)


def test_a_known_controller_looks_the_same_everywhere_and_no_colour_comes_twice() -> None:
    assert set(ORDER) == {each.name for each in benchmark.classical() if each.default} | set(benchmark.SHIPPED)
    alone, others = styles(["lqg-at-0.02"]), (f"c{i}" for i in range(len(COLOURS) - 1 - len(ORDER)))
    everyone = styles_of([sample(name, 1.0).controller for name in ("mine", *ORDER, *others)])
    assert everyone["lqg-at-0.02"] == alone["lqg-at-0.02"]
    assert len({one.colour for one in everyone.values()}) == len(everyone) == len(COLOURS)
    few = styles(["lqg-at-0.02", *(f"c{i}" for i in range(len(COLOURS) - 1))])
    assert len({one.colour for one in few.values()}) == len(COLOURS), "colours of those who are absent are free"
    assert len(COLOURS) >= NAMED
    many = styles([f"c{i}" for i in range(40)]).values()
    assert len({(one.colour, one.dash) for one in many}) == 40, "on a page every one has a line of its own"


def test_figures_of_a_crystal_that_nothing_disturbs_and_of_a_name_that_seems_a_formula() -> None:
    results = []
    for name in ("nominal", "randomized"):
        row = find_row(name)
        run = rollout(OpenLoop(), make_config(name, horizon=600.0), row.seeds(2))
        names = ["a $\\frac$ b", *(f"c{i}" for i in range(COLUMNS))]
        results.append(summarise(row, [sample_of(Controller(name, "measured", "", (1,)), [run]) for name in names]))
    figures = draw_figures(Benchmark(tuple(results), "", ()))
    assert set(figures) == {"crystal.png", "errors.png", "pareto.png"}
    assert all(image.startswith(b"\x89PNG") for image in figures.values())
    inches = Image.open(io.BytesIO(figures["crystal.png"])).width / DPI
    assert 830.0 / inches * 8.0 / 72.0 > 10.0, "8 point text is too small where a page shows the figure 830 pixels wide"
