"""Figures: who is shown when there are many, colours, and a crystal that nothing disturbs."""

import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from cz_gym.baselines import OpenLoop
from cz_gym.config import make_config
from cz_gym.evaluation.metrics import metric_names
from cz_gym.evaluation.plots import COLOURS, COLUMNS, DPI, chosen, styles_of
from cz_gym.evaluation.protocol import find_case
from cz_gym.evaluation.results import Sample, summarise
from cz_gym.evaluation.rollout import rollout
from cz_gym.tools.registry import CONTROLLERS
from cz_gym.tools.report.figures import NAMED, draw_figures
from cz_gym.tools.report.markdown import brief
from tests.observed import PLAIN
from tests.samples import contender

AGENTS = {"gradient": 0.05, "ppo": 0.06, "sac": 0.2, "ppo-plain": 0.3}
"""Shipped agents with their RMSE [mm], as on the test crystals."""


def sample(name, rmse, **facts):
    values = np.full((1, 1, len(metric_names())), rmse)
    return Sample(contender(name, **facts), (7,), values, 0.0)


def names(samples):
    return [one.name for one in samples]


def everyone():
    """The default table: classical controllers of the registry, and the shipped agents."""
    classical = [replace(sample(each.name, 0.1), contender=each) for each in CONTROLLERS if each.default]
    return classical + [sample(*each, training_seeds=(0,)) for each in AGENTS.items()]


def test_many_controllers_are_chosen_by_a_rule():
    many = [sample("bound", 0.1, observation="state"), sample("paper", 9.0)]
    many += [*(sample(f"c{i}", 1.0 + i) for i in range(6)), sample("ppo", 99.0, training_seeds=(0,))]
    shown = chosen(many, 4)
    assert names(shown) == ["paper", "c0", "c1", "ppo"]
    assert chosen(many[::-1], 4) == shown[::-1]
    assert chosen(many, 99) == many


def test_figure_and_short_table_show_who_is_quoted_the_best_agents_and_one_s_own():
    usual = ["paper", "paper-tuned", "lqg-at-0.02", "lqg-one-design", "gradient", "ppo"]
    assert names(chosen(everyone(), COLUMNS)) == usual
    mine = [*everyone(), sample("mine", 50.0, own=True)]
    assert {"paper", "mine", "gradient"} < set(names(chosen(mine, COLUMNS)))
    lines = brief([summarise(find_case("nominal"), everyone())]).split("\n\n")[0].splitlines()
    shown = [line.split(" | ")[0].strip("| ") for line in lines[2:]]
    assert [name for name in shown if "*" not in name] == [*usual, "sac", "ppo-plain"]
    assert [name for name in shown if "*" in name] == ["*classical*", "*learned from the reward*"]


def test_no_two_controllers_look_alike():
    assert len(COLOURS) >= NAMED
    known = styles_of(everyone())
    assert len({one.colour for one in known.values()}) == len(known) == len(everyone())


@pytest.mark.filterwarnings("error")
def test_figures_of_a_crystal_that_nothing_disturbs_and_of_a_name_that_seems_a_formula():
    results = []
    for name in ("nominal", "randomized"):
        row = find_case(name)
        run = rollout(OpenLoop(), make_config(name, horizon=600.0, **PLAIN), row.seeds(2))
        who = ["a $\\frac$ b", *(f"c{i}" for i in range(COLUMNS))]
        results.append(summarise(row, [Sample.of(contender(each, training_seeds=(1,)), [run]) for each in who]))
    figures = draw_figures(results)
    assert set(figures) == {"crystal.png", "pareto.png"}
    assert all(image.startswith(b"\x89PNG") for image in figures.values())
    inches = Image.open(io.BytesIO(figures["crystal.png"])).width / DPI
    assert 830.0 / inches * 8.0 / 72.0 > 10.0, "8 point text is too small where a page shows the figure 830 pixels wide"
